# This source code is licensed under the MIT license found in the LICENSE file.
"""Where unlabelled data pay, in closed loop: controllers follow demonstrations not seen before, by regime.

    koap demos --out runs/avoiding96 --episodes 96 --seed 11
    python benchmarks/unlabelled_rollouts.py --dataset runs/avoiding96 --regimes noise wide_64 distractors

The planner takes no part: at every step the plan is what the demonstration did next, as the sensor of the regime showed
it (with its noise), bent towards the present observation as the library's policies do. The robot's own motion is
simulated, and what the controller sees of it goes through the same sensor, with fresh noise: the same noise for every
controller of a seed, whichever rows are run. Training, labels and seeds are those of ``unlabelled_data.py``, whose rows
``--errors`` writes as well: one training for both. Judged are the last trajectories of a seed's order. Success is the
task's. ``--labels-from play``: as there.
"""

from __future__ import annotations

import argparse
import warnings
from itertools import product
from pathlib import Path

import torch
import unlabelled_data
from regimes import REGIMES, RegimeSensor
from resumable_table import open_table
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import step_mdp
from unlabelled_data import (
    METHODS,
    PLAY_SUFFIX,
    PLAYED,
    add_play,
    as_own_data,
    controllers,
    error_row,
    load_positions,
    shuffled_trajectories,
)

from torchrl_koap.envs.registry import make_env
from torchrl_koap.modules import Execution, InverseDynamics, blend_plan
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.tasks import Task
from torchrl_koap.training.datasets import find_task_of

TABLE = Path(__file__).parent / "results" / "unlabelled_rollouts.csv"
COLUMNS = (
    "dataset",
    "regime",
    "labels",
    "seed",
    "method",
    "blend_decay",
    "n",
    "successes",
    "collisions",
    "distance_mm",
)
Cell = tuple[str, int]  # method, number of labelled trajectories
HORIZON = 14
NOISE_SEED = 2000  # plus the seed: noise of the rollouts, apart from that of the demonstrations
SPARE = 40  # control steps that a rollout may take longer than its demonstration


def padded(paths: list[torch.Tensor], length: int) -> torch.Tensor:
    """Paths as ``[E, length, ...]``, their last row repeated."""
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
        controller (InverseDynamics): reads windows of what the sensor shows.
        sensor (RegimeSensor): of the regime.
        shown (TensorDictBase): flat data with the recorded positions as ``observation``, what the sensor showed of them
            as ``state``, and ``distractors`` where the regime has some.
        task (Task): has the environment; the robot's position is what the sensor is asked for.
        episodes (Tensor): numbers of the demonstrations.
        decay (float): with which plans are bent towards the present observation.
        seed (int): of the noise on what is observed.

    Returns:
        dict: successes, collisions, mean distance to the demonstration over the steps of running episodes (mm).
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


def run_seed(
    data: TensorDictBase,
    source: Task,
    regime: str,
    seed: int,
    follows: list[Cell],
    judges: list[Cell],
    played: int,
    options: argparse.Namespace,
):
    """Rolls out the controllers of one regime and seed; the last ``played`` trajectories are random play.

    Args:
        data (TensorDictBase): flat data with the recorded positions as ``state``.
        source (Task): has the environment.
        regime (str): its name.
        seed (int): of labels, noise and training.
        follows (list of tuple): methods and numbers of labelled trajectories that are rolled out.
        judges (list of tuple): those whose action error is measured.
        played (int): trajectories of random play.
        options (Namespace): ``judged`` and ``blend_decay``.

    Yields:
        tuple: method and number of labelled trajectories, what :func:`follow` found, or None, and what
        :func:`unlabelled_data.error_row` says, or None.
    """
    asked = {*follows, *judges}
    wanted = [cell for cell in product(options.methods, options.labels) if cell in asked]  # each is trained once
    if not wanted:
        return
    sensor = RegimeSensor(data, regime, seed=seed)
    seen = data.copy().set("state", sensor.noisy(sensor.recorded).to(data["state"].dtype))
    full, task = as_own_data(seen)
    places = torch.unique(data["episode"], return_inverse=True)[1]  # as data of one's own are numbered
    numbers = shuffled_trajectories(full, seed, played)
    shown = seen.copy().set("observation", data["state"]).set("episode", places)
    if sensor.distractors is not None:
        shown["distractors"] = sensor.distractors
    for method, labels, controller, fit, updates in controllers(full, task, numbers, seed, wanted):
        cell, found, error = (method, labels), None, None
        if cell in judges:
            error = error_row(controller, full, numbers, source.action_unit, fit, updates)
        if cell in follows:
            judged = numbers[-options.judged :]
            found = follow(controller, sensor, shown, source, judged, options.blend_decay, NOISE_SEED + seed)
            found |= {"distance_mm": f"{found['distance_mm']:.2f}"}
        yield cell, found, error


def _key(source: Task, regime: str, seed: int, cell: Cell) -> tuple[str, ...]:
    method, labels = cell
    return source.name, regime, str(labels), str(seed), method


def main() -> None:
    """Runs what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", required=True, help="folder written by koap demos --task avoiding")
    parser.add_argument("--regimes", nargs="+", default=["noise", "wide_64", "distractors"], choices=list(REGIMES))
    methods = ["semi_supervised", "koap_untrained", "koap_labelled_only", "pca", "linear_steps"]
    parser.add_argument("--methods", nargs="+", default=methods, choices=list(METHODS))
    parser.add_argument("--labels", nargs="+", type=int, default=[1, 2, 4])
    parser.add_argument("--labels-from", default="demonstrations", choices=["demonstrations", "play"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--judged", type=int, default=60, help="demonstrations followed per seed")
    parser.add_argument("--blend-decay", type=float, default=Execution().blend)
    parser.add_argument("--table", type=Path, default=TABLE)
    errors = unlabelled_data.TABLE
    parser.add_argument("--errors", type=Path, nargs="?", const=errors, help="write rows of unlabelled_data.py as well")
    options = parser.parse_args()
    warnings.filterwarnings("ignore", category=UserWarning)
    torch.set_num_threads(1)
    source = find_task_of(options.dataset)
    if source.name != "avoiding":
        parser.error(f"{options.dataset} holds demonstrations of {source.name}: Avoiding's alone need no objects")
    data, _ = load_positions(options.dataset, 10**6)
    if len(data["episode"].unique()) < options.judged + max(options.labels):
        parser.error(f"{options.dataset} has fewer demonstrations than are judged and labelled")
    played = PLAYED if options.labels_from == "play" else 0
    if played:
        data = add_play(data, options.dataset)
    suffix = PLAY_SUFFIX if played else ""
    done, write = open_table(options.table, COLUMNS, COLUMNS[:6])
    known, write_error = set(), None
    if options.errors is not None:
        known, write_error = open_table(options.errors, unlabelled_data.COLUMNS, unlabelled_data.COLUMNS[:5])
    cells, decay = list(product(options.methods, options.labels)), str(options.blend_decay)
    with progress_bar(len(options.regimes) * len(options.seeds) * len(cells), "cells") as bar:
        for regime, seed in product(options.regimes, options.seeds):
            keys = {cell: _key(source, regime + suffix, seed, cell) for cell in cells}
            follows = [cell for cell in cells if (*keys[cell], decay) not in done]
            judges = [cell for cell in cells if write_error is not None and keys[cell] not in known]
            bar.update(len(cells) - len({*follows, *judges}))
            for cell, found, error in run_seed(data, source, regime, seed, follows, judges, played, options):
                if found is not None:
                    write((*keys[cell], decay, options.judged, *found.values()))
                if error is not None:
                    write_error((*keys[cell], *error))
                bar.update()


if __name__ == "__main__":
    main()
