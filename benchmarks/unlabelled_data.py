# This source code is licensed under the MIT license found in the LICENSE file.
"""Where unlabelled data pay: action errors of controllers against labelled trajectories, in regimes of observation.

    koap demos --out runs/avoiding96
    python benchmarks/unlabelled_data.py --dataset runs/avoiding96 --regimes plain noise wide_64
    python benchmarks/unlabelled_data.py --dataset runs/avoiding96 --regimes wide_64 --labels-from play
    python benchmarks/unlabelled_data.py --dataset runs/stacking --regimes joints_hidden

Every method sees the same observations (with noise in training and in the trajectories it is judged on) and the same
labelled trajectories, and all other trajectories without labels. The error is that of one decoded action on 24
other trajectories, whose actions are read for it alone. With ``--labels-from play`` no demonstration has labels: they
come from random play of the same robot (:mod:`torchrl_koap.envs.experts.random_play`). Rows are appended to the table
as they are known; what is there already is not run again.

What is trained without labels is trained once for all numbers of labelled trajectories of a seed: the weights are those
that separate trainings would give, for no label is read before the closed form at the end.
"""

from __future__ import annotations

import argparse
import copy
import warnings
from pathlib import Path

import torch
from regimes import REGIMES, Regime, apply_regime
from resumable_table import open_table
from tensordict import TensorDictBase

from torchrl_koap.data import controller_view, make_demonstrations, select_state
from torchrl_koap.envs.experts.random_play import record_random_play
from torchrl_koap.modules import InverseDynamics, Normalizer
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.tasks import Task
from torchrl_koap.training import fit as fit_in_memory
from torchrl_koap.training.action_errors import first_actions, rmse
from torchrl_koap.training.closed_form import axes_of, fit_closed_form
from torchrl_koap.training.datasets import find_task_of, load_demonstrations

TABLE = Path(__file__).parent / "results" / "unlabelled_data.csv"
COLUMNS = ("dataset", "regime", "labels", "seed", "method", "error", "unit", "choice", "updates")
# what --methods calls them: method, preset, updates, does training read labels
LIFT = {"controller_batch_size": 64, "controller_learning_rate": 5e-3}
METHODS = {
    "semi_supervised": ("koap", "semi_supervised", 1000, False, LIFT),
    "semi_supervised, untrained": ("koap_untrained", "semi_supervised", 0, False, {}),
    "semi_supervised, labelled only": ("koap_labelled_only", "semi_supervised", 1000, True, LIFT),
    "koap": ("koap", "default", 500, False, {}),
    "koap_untrained": ("koap_untrained", "default", 0, False, {}),
    "koap_labelled_only": ("koap_labelled_only", "default", 500, True, {}),
    "koap_paper": ("koap_paper", None, 500, True, {}),
    "pca": ("pca", None, 0, False, {}),
    "linear_steps": ("linear_steps", None, 0, False, {}),
    "dd_lookahead": ("dd_lookahead", None, 500, True, {}),
}
JUDGED = 24  # trajectories, the last of a seed's order, that controllers are judged on
PLAY_PUSH = 0.008  # m, about the demonstrations' own steps
PLAY_BOUNDS = ((0.25, 0.75), (-0.25, 0.33))  # m
PLAYED = 16  # motions of random play
PLAY_SUFFIX = ", play"  # of what the table calls a regime
HIDDEN = Regime("joints_hidden", "Stacking, joints hidden", hidden=tuple(range(7)))


def robot_view(data: TensorDictBase, task: Task) -> TensorDictBase:
    """Flat data with the robot's own columns as ``state``."""
    return controller_view(data, task.controller_columns("robot"), targets=task.targets)


def load_positions(dataset: str, most: int) -> tuple[TensorDictBase, str]:
    """Flat data with what the robot's controller could read as ``state``, and the unit of its actions."""
    task = find_task_of(dataset)
    data = load_demonstrations(dataset, task)
    if task.source == "stacking":  # joints, gripper, tool; the gripper's action has no unit and is left out
        data = data.copy().set("state", data["state"][:, :11]).set("action", data["action"][:, :7])
    else:
        data = robot_view(data, task)
    return data[torch.isin(data["episode"], data["episode"].unique()[:most])], task.action_unit


def add_play(data: TensorDictBase, dataset: str) -> TensorDictBase:
    """The data and, with the highest numbers, motions of random play of the same robot."""
    task = find_task_of(dataset)
    play = record_random_play(task, PLAYED, push=PLAY_PUSH, bounds=PLAY_BOUNDS)
    play = robot_view(select_state(play, task.state_of), task)
    play["episode"] += 1 + data["episode"].max()
    return torch.cat([data.select(*play.keys(include_nested=True, leaves_only=True)), play])


def as_own_data(data: TensorDictBase) -> tuple[TensorDictBase, Task]:
    """The data as those of a robot about which nothing is known, with all labels."""
    parts = [data[data["episode"] == number] for number in data["episode"].unique()]
    states, actions = ([part[key].numpy() for part in parts] for key in ("state", "action"))
    made, task = make_demonstrations(states, actions, control_hz=30)
    return select_state(made, task.state_of), task


def with_labels(data: TensorDictBase, episodes: torch.Tensor) -> TensorDictBase:
    """The data with the actions of some trajectories alone."""
    kept = data["has_action"] & torch.isin(data["episode"], episodes)[:, None]
    return data.copy().set("has_action", kept).set("action", data["action"].where(kept, torch.nan))


def refit(controller: InverseDynamics, data: TensorDictBase, task: Task) -> tuple[InverseDynamics, dict]:
    """The closed form of a controller on other labels."""
    controller = copy.deepcopy(controller)
    mode = Normalizer.fit(data["action"], mode="rms", mask=data["has_action"])
    controller.action_normalizer.load_state_dict(mode.state_dict())
    return controller, fit_closed_form(controller, data, **axes_of(task, task.controller_columns("robot")))


def choice_of(controller: InverseDynamics, fit: dict) -> str:
    """What the held-out labelled error chose."""
    gate = getattr(controller, "gate", None)
    return fit.get("block", "") if gate is None else str(int(gate.sum()))


def controllers(full: TensorDictBase, task: Task, numbers: torch.Tensor, seed: int, wanted: list[tuple[str, int]]):
    """Trained controllers by method and number of labelled trajectories, the first of ``numbers``.

    Yields:
        tuple: method, labelled trajectories, controller, what fitting it reported, updates.
    """
    last, trained = None, None
    for method, labels in wanted:
        kind, preset, updates, reads_labels, settings = METHODS[method]
        if preset == "semi_supervised" and full["state"].shape[-1] <= 8:
            updates = 0  # the state is its own lifting: nothing that is trained would be read
        part = with_labels(full, numbers[:labels])
        if last != method or reads_labels:
            section = {"steps": updates, "preset": preset or None}
            made = fit_in_memory(part, task, method=kind, planner=False, controller=section, seed=seed, progress=False)
            trained = made.controller
            controller, fit, last = trained, made.results["decoder_fit"], method
        else:
            controller, fit = refit(trained, part, task)
        yield method, labels, controller, fit, updates


def shuffled_trajectories(data: TensorDictBase, seed: int, played: int = 0) -> torch.Tensor:
    """Numbers of the trajectories in the order of a seed: the first ones get labels, the last ones are judged.

    Args:
        data (TensorDictBase): flat data.
        seed (int): of the order.
        played (int): how many of the highest numbers are random play, which comes first.
    """
    numbers, generator = data["episode"].unique(), torch.Generator().manual_seed(seed)
    count = len(numbers) - played
    shuffled = [torch.randperm(played, generator=generator) + count] if played else []
    return numbers[torch.cat([*shuffled, torch.randperm(count, generator=generator)])]


def error_row(
    controller: InverseDynamics, full: TensorDictBase, numbers: torch.Tensor, unit: str, fit: dict, updates: int
) -> tuple[str, str, str, int]:
    """What the table says of a controller: error of one decoded action, its unit, what was chosen, updates."""
    predicted, true, _ = first_actions(controller, full, numbers[-JUDGED:])
    shown = {"m": "mm", "rad": "mrad"}[unit]
    return f"{rmse(predicted, true, unit):.4f}", shown, choice_of(controller, fit), updates


def run_regime(data, unit, name, regime, options, write, done, bar) -> None:
    """All cells of one regime."""
    for seed in options.seeds:
        full, task = as_own_data(apply_regime(data, regime, seed=seed))
        numbers = shuffled_trajectories(full, seed, PLAYED if options.labels_from == "play" else 0)
        cells = [(method, labels) for method in options.methods for labels in options.labels]
        label = regime.name + PLAY_SUFFIX * (options.labels_from == "play")
        wanted = [cell for cell in cells if (str(name), label, str(cell[1]), str(seed), cell[0]) not in done]
        bar.update(len(cells) - len(wanted))
        for method, labels, controller, fit, updates in controllers(full, task, numbers, seed, wanted):
            row = error_row(controller, full, numbers, unit, fit, updates)
            write((str(name), label, str(labels), str(seed), method, *row))
            bar.update()


def main() -> None:
    """Runs what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", required=True, help="folder written by koap demos")
    parser.add_argument("--regimes", nargs="+", default=list(REGIMES), choices=[*REGIMES, HIDDEN.name])
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--labels", nargs="+", type=int, default=[1, 2, 4, 8, 16])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--labels-from", default="demonstrations", choices=["demonstrations", "play"])
    parser.add_argument("--trajectories", type=int, default=96, help="demonstrations used at most")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    warnings.filterwarnings("ignore", category=UserWarning)
    torch.set_num_threads(1)
    data, unit = load_positions(options.dataset, options.trajectories)
    name = find_task_of(options.dataset).name
    if options.trajectories < JUDGED + max(options.labels):
        parser.error(f"--trajectories must be at least {JUDGED} judged ones and those with labels")
    if options.labels_from == "play":
        data = add_play(data, options.dataset)
    done, write = open_table(options.table, COLUMNS, COLUMNS[:5])
    cells = len(options.regimes) * len(options.seeds) * len(options.methods) * len(options.labels)
    with progress_bar(cells, "cells") as bar:
        for regime in options.regimes:
            regime = HIDDEN if regime == HIDDEN.name else REGIMES[regime]
            run_regime(data, unit, name, regime, options, write, done, bar)


if __name__ == "__main__":
    main()
