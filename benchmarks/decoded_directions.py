# This source code is licensed under the MIT license found in the LICENSE file.
"""How much of a planned motion a controller decodes, direction by direction, while a tool is at work.

    python benchmarks/decoded_directions.py runs/aligning --dataset DEMOS

The robot rests where demonstrations move an object; the plan leads away in a straight line, 3 mm per control step along
one axis. The decoded share is the first action along that axis over those 3 mm: 1 follows, 0 stands still. A direction
in which no demonstration ever commanded a motion need not be decoded at all. Tasks whose actions move a tool alone.

Rows are appended to the table; what is there already is left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from planner_ablations import disturbance_notes, labels_of
from resumable_table import open_table
from tensordict import TensorDict

from torchrl_koap.evaluation.trained_run import load_run
from torchrl_koap.tasks import Task
from torchrl_koap.training.datasets import load_demonstrations

TABLE = Path(__file__).parent / "results" / "decoded_directions.csv"
COLUMNS = ("task", "run", "labels", "disturbed", "planned", "places", "share", "low", "high")
PACE, AHEAD, PLACES, MOVED = 0.003, 14, 500, 0.001  # m, control steps, number, m


def disturbed_how(dataset: str) -> str:
    """How the operators of a data set were disturbed, in words."""
    kept = disturbance_notes(dataset).get("kept", {})
    sideways = any(count for kind, count in kept.items() if kind != "drift")
    ways = [word for word, there in (("sideways", sideways), ("in height", kept.get("drift"))) if there]
    return " and ".join(ways) or "never"


def working_places(task: Task, dataset: str) -> torch.Tensor:
    """States ``[PLACES, d]`` of demonstrations in which an object moves by more than a millimetre."""
    data = load_demonstrations(dataset, task)
    first = task.observation[task.bodies[0].position]
    moved = (data["next", "observation"][:, first] - data["observation"][:, first]).norm(dim=-1) > MOVED
    states = data["state"][moved]
    return states[torch.randperm(len(states), generator=torch.Generator().manual_seed(0))[:PLACES]]


@torch.no_grad()
def decoded(controller, columns: list[int], states: torch.Tensor, axis: int, sign: int) -> torch.Tensor:
    """First decoded action along an axis over the planned step, of a robot at rest, for every place ``[N]``."""
    past, robot = controller.num_past, states[:, columns]
    window = robot[:, None].repeat(1, past + 1 + AHEAD, 1)
    window[:, past + 1 :, axis] += sign * PACE * torch.arange(1, AHEAD + 1)
    action = controller(TensorDict({"state": window}, batch_size=[len(window)]))["action"]
    return sign * action[:, past, axis] / PACE


def main() -> None:
    """Adds what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--dataset", required=True, help="demonstrations, where the robot rests")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    done, write = open_table(options.table, COLUMNS, COLUMNS[:5])
    places: dict[str, torch.Tensor] = {}
    for path in options.runs:
        trained = load_run(path)
        task, config = trained.task, trained.config
        if task.name not in places:
            places[task.name] = working_places(task, options.dataset)
        states = places[task.name]
        columns = list(trained.columns)
        facts = (task.name, path.name, labels_of(config), disturbed_how(config["dataset"]))
        for axis, letter in enumerate("xyz"[: task.action_dim]):
            for sign in (1, -1):
                planned = ("+" if sign > 0 else "-") + letter
                if (*facts, planned) in done:
                    continue
                share = decoded(trained.controller, columns, states, axis, sign)
                low, middle, high = share.quantile(torch.tensor([0.1, 0.5, 0.9])).tolist()
                write((*facts, planned, len(states), f"{middle:.3f}", f"{low:.3f}", f"{high:.3f}"))
                print(path.name, planned, f"{middle:.2f} ({low:.2f} to {high:.2f})")


if __name__ == "__main__":
    main()
