# This source code is licensed under the MIT license found in the LICENSE file.
"""Compares controllers by number of labelled trajectories under several observation models.

    koap demos --out runs/avoiding96 --episodes 96 --seed 11
    python benchmarks/unlabelled.py --dataset runs/avoiding96 --observed plain noise wide_64 --rollouts
    python benchmarks/unlabelled.py --dataset runs/stacking --observed joints_hidden

All methods get the same observations, with noise in training and test trajectories, the same labelled trajectories and
all other trajectories without labels. The error is that of one decoded action on 24 test trajectories, whose actions
only this error reads. With ``--rollouts`` the controllers follow held-out demonstrations in the simulation of Avoiding.
At every step the plan is the continuation of the observed demonstration, blended with the present observation as the
library's policies do. The same sensor observes the robot, with fresh noise that is the same for every controller of a
seed.

Methods trained without labels are trained once per seed for all numbers of labelled trajectories. Separate trainings
would give the same weights, since only the final closed-form fit reads labels. Rows of the tables are not run again.
"""

from __future__ import annotations

import copy
import warnings
from itertools import product
from pathlib import Path

import torch
import tyro
from regimes import REGIMES, Regime, RegimeSensor
from tables import open_table
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import step_mdp

from torchrl_koap import fit
from torchrl_koap.data import make_demonstrations, open_dataset, select_state
from torchrl_koap.data.sources import find_task_of
from torchrl_koap.envs.registry import make_env
from torchrl_koap.evaluation.data_errors import first_actions
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import Execution, InverseDynamics, Normalizer, blend_plan
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.columns import thousandths
from torchrl_koap.training.closed_form import action_facts, fit_closed_form
from torchrl_koap.training.policy_facts import controller_data

RESULTS = Path(__file__).parent / "results"
KEYS = ("dataset", "regime", "labels", "seed", "method")
ERRORS = (*KEYS, "error", "unit", "choice", "updates")
ROLLOUTS = (*KEYS, "blend_decay", "n", "successes", "collisions", "distance_mm")
# name for --methods: method, preset, updates, whether training reads labels
METHODS = {
    "semi_supervised": ("koap", "semi_supervised", 1000, False),
    "semi_supervised, untrained": ("koap_untrained", "semi_supervised", 0, False),
    "semi_supervised, labelled only": ("koap_labelled_only", "semi_supervised", 1000, True),
    "koap": ("koap", "default", 500, False),
    "koap_untrained": ("koap_untrained", "default", 0, False),
    "koap_labelled_only": ("koap_labelled_only", "default", 500, True),
    "koap_paper": ("koap_paper", None, 500, True),
    "pca": ("pca", None, 0, False),
    "linear_steps": ("linear_steps", None, 0, False),
    "dd_lookahead": ("dd_lookahead", None, 500, True),
}
OBSERVED = REGIMES | {"joints_hidden": Regime("joints_hidden", hidden=tuple(range(7)))}
JUDGED = 24  # test trajectories for the error of controllers: the last ones in the order of a seed
HORIZON = 14
NOISE_SEED = 2000  # added to the seed, so that the noise of rollouts differs from that of demonstrations
SPARE = 40  # control steps that a rollout may take longer than its demonstration
Cell = tuple[str, int]  # method, number of labelled trajectories


def robot_view(data: TensorDictBase, task: Task) -> TensorDictBase:
    """Returns flat data with the robot's columns as ``state``; targets, but not commands, become distances."""
    return controller_data(task, ControllerConfig(columns="robot"), data)


def load_positions(dataset: str, most: int) -> tuple[TensorDictBase, str]:
    """Returns flat data with the columns that a controller may read as ``state``, and the unit of the actions."""
    data, task = open_dataset(dataset)
    if task.source == "stacking":  # joints, gripper, tool; the gripper's action has no unit and is left out
        data = data.copy().set("state", data["state"][:, :11]).set("action", data["action"][:, :7])
    else:
        data = robot_view(data, task)
    return data[torch.isin(data["episode"], data["episode"].unique()[:most])], task.action_units[0]


def as_own_data(data: TensorDictBase) -> tuple[TensorDictBase, Task]:
    """Converts the data, with all labels, to those of a robot without a registered task; returns data and task."""
    parts = [data[data["episode"] == number] for number in data["episode"].unique()]
    states, actions = ([part[key].numpy() for part in parts] for key in ("state", "action"))
    made, task = make_demonstrations(states, actions, control_hz=30)
    return select_state(made, task.state_of), task


def with_labels(data: TensorDictBase, episodes: torch.Tensor) -> TensorDictBase:
    """Returns the data with the actions of the given trajectories only."""
    kept = data["has_action"] & torch.isin(data["episode"], episodes)[:, None]
    return data.copy().set("has_action", kept).set("action", data["action"].where(kept, torch.nan))


def refit(controller: InverseDynamics, data: TensorDictBase, task: Task) -> tuple[InverseDynamics, dict]:
    """Repeats the closed-form fit of a copied controller on other labels; returns it and the fit's report."""
    controller = copy.deepcopy(controller)
    normalizer = Normalizer.fit(data["action"], mode="rms", mask=data["has_action"])
    controller.action_normalizer.load_state_dict(normalizer.state_dict())
    return controller, fit_closed_form(controller, data, **action_facts(task, task.controller_columns("robot")))


def choice_of(controller: InverseDynamics, found: dict) -> str:
    """Returns the block or the number of components chosen by the held-out error on labels."""
    gate = getattr(controller, "gate", None)
    return found.get("block", "") if gate is None else str(int(gate.sum()))


def controllers(full: TensorDictBase, task: Task, numbers: torch.Tensor, seed: int, wanted: list[Cell]):
    """Trains a controller per method and number of labelled trajectories, the first of ``numbers``.

    Yields:
        tuple: method, labelled trajectories, controller, report of the fit, updates.
    """
    last, trained = None, None
    for method, labels in wanted:
        kind, preset, updates, reads_labels = METHODS[method]
        if preset == "semi_supervised" and full["state"].shape[-1] <= 8:
            updates = 0  # narrow states are their own lifting, so that no trained weight is used
        part = with_labels(full, numbers[:labels])
        if last != method or reads_labels:
            options = {"steps": updates} | ({"preset": preset} if preset else {})
            made = fit(part, task, method=kind, planner=False, controller=options, seed=seed, progress=False)
            trained, last = made.controller, method
            yield method, labels, trained, made.results["decoder_fit"], updates
        else:
            yield method, labels, *refit(trained, part, task), updates


def shuffled_trajectories(data: TensorDictBase, seed: int) -> torch.Tensor:
    """Shuffles the trajectory numbers by a seed: the first ones get labels, the last ones are for testing."""
    numbers, generator = data["episode"].unique(), torch.Generator().manual_seed(seed)
    return numbers[torch.randperm(len(numbers), generator=generator)]


def error_row(controller: InverseDynamics, full: TensorDictBase, numbers: torch.Tensor, unit: str) -> tuple[str, str]:
    """Returns the error of one decoded action, and its unit."""
    predicted, true, _ = first_actions(controller, full, numbers[-JUDGED:])
    shown, factor = thousandths(unit)
    return f"{factor * (predicted - true).square().mean().sqrt().item():.4f}", shown


def padded(paths: list[torch.Tensor], length: int) -> torch.Tensor:
    """Stacks paths as ``[E, length, ...]``, padded by their last row."""
    return torch.stack([path[torch.arange(length).clamp_max(len(path) - 1)] for path in paths])


@torch.no_grad()
def follow(
    controller: InverseDynamics,
    sensor: RegimeSensor,
    shown: TensorDictBase,
    task: Task,
    episodes: torch.Tensor,
    decay: float,
    seed: int,
) -> dict[str, float]:
    """Rolls out one episode per demonstration.

    Args:
        controller (InverseDynamics): controller that reads windows of sensor observations.
        sensor (RegimeSensor): sensor of the regime.
        shown (TensorDictBase): flat data with the recorded positions as ``observation``, their sensor observations as
            ``state``, and ``distractors`` if the regime has any.
        task (Task): task of the environment; the sensor observes the robot's position.
        episodes (Tensor): numbers of the demonstrations.
        decay (float): decay of the blend of plans with the present observation.
        seed (int): seed of the observation noise.

    Returns:
        dict: successes, collisions, mean distance to the demonstration while episodes run (mm).
    """
    parts = [shown[shown["episode"] == number] for number in episodes]
    steps = max(len(part) for part in parts) + SPARE
    plans, paths = (padded([part[key] for part in parts], steps + HORIZON) for key in ("state", "observation"))
    moving = padded([part["distractors"] for part in parts], steps + 1) if sensor.distractors is not None else None
    columns = list(task.state_columns)[: paths.shape[-1]]
    env = make_env(task, len(parts), max_steps=steps)
    td, history = env.reset(), []
    running, distances = torch.ones(len(parts), dtype=torch.bool), []
    outcome = torch.zeros(2, len(parts), dtype=torch.bool)
    noise = torch.Generator().manual_seed(seed)
    for step in range(steps):
        beside = None if moving is None else moving[:, max(step - 1, 0)]
        seen = sensor.noisy(sensor.show(td["observation"][:, columns].to(paths), beside), noise).to(plans)
        history = ([seen] * (controller.num_past + 1) if not history else [*history, seen])[-controller.num_past - 1 :]
        observed = torch.stack(history, 1)
        plan = blend_plan(observed, plans[:, step : step + HORIZON], decay)
        window = TensorDict({"state": torch.cat([observed, plan], 1)}, [len(parts)])
        td = env.step(td.set("action", controller(window)["action"][:, controller.num_past]))["next"]
        ended = running & td["done"].squeeze(-1)
        outcome[0] |= ended & td["success"].squeeze(-1)
        outcome[1] |= ended & td["terminated"].squeeze(-1) & ~td["success"].squeeze(-1)
        running &= ~ended
        if not running.any():
            break
        distances.append((td["observation"][:, columns] - paths[:, step]).norm(dim=-1)[running])
        td = step_mdp(TensorDict({"next": td}, td.batch_size))
    env.close()
    return {
        "successes": int(outcome[0].sum()),
        "collisions": int(outcome[1].sum()),
        "distance_mm": 1e3 * float(torch.cat(distances).mean()),
    }


def run_seed(data, source: Task, unit: str, regime: Regime, seed: int, judges, follows, judged: int):
    """Trains the controllers of one setting and seed, measures errors and rolls them out.

    Args:
        data (TensorDictBase): flat data with the recorded positions as ``state``.
        source (Task): task of the environment.
        unit (str): unit of the actions.
        regime (Regime): observation model.
        seed (int): seed of labels, noise and training.
        judges (list of tuple): cells (method, labelled trajectories) whose error is measured.
        follows (list of tuple): cells that are rolled out.
        judged (int): number of demonstrations to follow.

    Yields:
        tuple: the cell, its columns of the table of errors or None, the result of :func:`follow` or None.
    """
    wanted = list(dict.fromkeys([*judges, *follows]))  # each is trained once
    wanted.sort(key=lambda cell: (list(METHODS).index(cell[0]), cell[1]))
    if not wanted:
        return
    sensor = RegimeSensor(data, regime, seed=seed)
    seen = data.copy().set("state", sensor.noisy(sensor.recorded).to(data["state"].dtype))
    full, task = as_own_data(seen)
    numbers = shuffled_trajectories(full, seed)
    places = torch.unique(data["episode"], return_inverse=True)[1]  # as in as_own_data
    shown = seen.copy().set("observation", data["state"]).set("episode", places)
    if sensor.distractors is not None:
        shown["distractors"] = sensor.distractors
    for method, labels, controller, found, updates in controllers(full, task, numbers, seed, wanted):
        cell, error, rolled = (method, labels), None, None
        if cell in judges:
            error = (*error_row(controller, full, numbers, unit), choice_of(controller, found), updates)
        if cell in follows:
            decay = Execution().blend
            rolled = follow(controller, sensor, shown, source, numbers[-judged:], decay, NOISE_SEED + seed)
            rolled |= {"distance_mm": f"{rolled['distance_mm']:.2f}"}
        yield cell, error, rolled


def main(
    *,
    dataset: Path,
    observed: tuple[str, ...] = tuple(REGIMES),
    methods: tuple[str, ...] = tuple(METHODS),
    labels: tuple[int, ...] = (1, 2, 4, 8, 16),
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4),
    rollouts: bool = False,
    judged: int = 60,
    trajectories: int = 96,
    folder: Path = RESULTS,
) -> None:
    """Runs the cells that the tables lack.

    Args:
        dataset: folder written by koap demos.
        observed: observation models: names of benchmarks/regimes.py or joints_hidden.
        methods: methods to compare.
        labels: numbers of labelled trajectories.
        seeds: seeds of labels, noise and training.
        rollouts: also roll the controllers out.
        judged: demonstrations to follow per seed.
        trajectories: maximum number of demonstrations.
        folder: folder of the tables.
    """
    for name in methods:
        lookup(METHODS, name, "method")
    regimes = [lookup(OBSERVED, name, "observation setting") for name in observed]
    source = find_task_of(dataset)
    if rollouts and source.name != "avoiding":
        raise ValueError(f"{dataset} holds demonstrations of {source.name}: rollouts are for Avoiding alone")
    warnings.filterwarnings("ignore", category=UserWarning)
    torch.set_num_threads(1)
    data, unit = load_positions(str(dataset), trajectories)
    needed = max(JUDGED, judged if rollouts else 0) + max(labels)
    if len(data["episode"].unique()) < needed:
        raise ValueError(f"{dataset} has fewer than {needed} demonstrations, the sum of tested and labelled ones")
    known, write_error = open_table(folder / "unlabelled_data.csv", ERRORS, KEYS)
    done, write = open_table(folder / "unlabelled_rollouts.csv", ROLLOUTS, KEYS) if rollouts else (set(), None)
    cells = list(product(methods, labels))
    with progress_bar(len(regimes) * len(seeds) * len(cells), "cells") as bar:
        for regime, seed in product(regimes, seeds):
            keys = {cell: (source.name, regime.name, str(cell[1]), str(seed), cell[0]) for cell in cells}
            judges = [cell for cell in cells if keys[cell] not in known]
            follows = [cell for cell in cells if rollouts and keys[cell] not in done]
            bar.update(len(cells) - len({*follows, *judges}))
            for cell, error, rolled in run_seed(data, source, unit, regime, seed, judges, follows, judged):
                if error is not None:
                    write_error((*keys[cell], *error))
                if rolled is not None:
                    write((*keys[cell], Execution().blend, judged, *rolled.values()))
                bar.update()


if __name__ == "__main__":
    tyro.cli(main)
