# This source code is licensed under the MIT license found in the LICENSE file.
"""How episodes end that run out of time: with the command run away, fingers closed on nothing, or in one place.

    koap eval runs/sorting
    python benchmarks/stuck_episodes.py runs/sorting runs/stacking

Reads the rollouts of the last evaluation of every run. An episode is counted once, in this order:

    runaway     the command was more than 0.15 m ahead of the tool (tasks whose actions move a tool)
    fingers     the fingers were narrower at the end than any box (tasks with a gripper)
    one place   the tool stayed within 10 cm for the last 100 steps, and no object moved by 2 mm
    moving      anything else

Rows are appended to the table; a run whose evaluation is there already is left out.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from planner_ablations import planner_source
from resumable_table import open_table
from torch import Tensor

from torchrl_koap.data.gripper_recovery import EMPTY
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_tensors
from torchrl_koap.tasks import Task, get_task

TABLE = Path(__file__).parent / "results" / "stuck_episodes.csv"
WAYS = ("runaway", "fingers", "one place", "moving")
COLUMNS = ("task", "run", "seed", "command_lead", "gripper_recovery", "n", "out_of_time", *WAYS)
RUNAWAY, PLACE, UNMOVED, STEPS = 0.15, 0.1, 0.002, 100  # m, m, m, control steps


def extent(path: Tensor) -> float:
    """Largest side of the box ``[T, ..., 2]`` that holds a path, over all of its bodies (m)."""
    return float((path.amax(0) - path.amin(0)).max())


def way_out(task: Task, action: Tensor, tool: Tensor, objects: Tensor) -> str:
    """How an episode ended.

    Args:
        task (Task): the task.
        action (Tensor): actions ``[T, act]``.
        tool (Tensor): horizontal positions ``[T + 1, 2]`` (m).
        objects (Tensor): horizontal positions ``[T + 1, objects, 2]`` (m).

    Returns:
        str: one of :data:`WAYS`.
    """
    if len(task.moved_columns()) >= 2:
        ahead = tool[0] + action[:, :2].cumsum(0) - tool[1:]
        if ahead.abs().max() > RUNAWAY:
            return "runaway"
    if "gripper" in task.actions and action[-STEPS // 5 :, task.action_names.index("gripper")].median() < EMPTY:
        return "fingers"
    if extent(tool[-STEPS:]) < PLACE and (not objects.shape[1] or extent(objects[-STEPS:]) < UNMOVED):
        return "one place"
    return "moving"


def row_of(path: Path) -> tuple[str, ...]:
    """The row of the last evaluation of a run."""
    run = RunDirectory(path)
    result, config = run.read_json("eval.json"), run.read_json("config.json")
    task = get_task(config["task"])
    rollouts, _ = load_tensors(run.path / "rollouts.safetensors")
    found: Counter[str] = Counter()
    for number, episode in enumerate(result["episode"]):
        if episode["outcome"] == "timeout":
            steps = int(rollouts["length"][number])
            tool, objects = (rollouts[name][number, : steps + 1] for name in ("position", "object_position"))
            found[way_out(task, rollouts["action"][number, :steps], tool, objects)] += 1
    _, trained = planner_source(config)
    options = (result["episode"][0]["seed"], result.get("command_lead", 0.0), trained.get("gripper_recovery") or 0.0)
    numbers = (*options, len(result["episode"]), found.total(), *(found[way] for way in WAYS))
    return task.name, path.name, *map(str, numbers)


def main() -> None:
    """Adds what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run directories with an evaluation")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    done, write = open_table(options.table, COLUMNS, COLUMNS[:4])
    for path in options.runs:
        row = row_of(path)
        if row[:4] not in done:
            write(row)
        print(dict(zip(COLUMNS, row, strict=True)))


if __name__ == "__main__":
    main()
