# This source code is licensed under the MIT license found in the LICENSE file.
"""How large decoded actions are against recorded ones: below 1 a robot is slower than what it follows.

    python benchmarks/decoded_sizes.py runs/po_sorting --dataset DEMOS

Perfect plans: the recorded future of the last demonstrations, seen through the sensor of the task. The share is the
sum of the decoded actions along the recorded ones over the sum of these, in steps that command more than 5 mm.

Rows are appended to the table; a run that is there already is left out.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from planner_ablations import labels_of
from resumable_table import open_table

from torchrl_koap.data import controller_view
from torchrl_koap.evaluation.trained_run import load_run
from torchrl_koap.training.action_errors import first_actions
from torchrl_koap.training.datasets import load_demonstrations

TABLE = Path(__file__).parent / "results" / "decoded_sizes.csv"
COLUMNS = ("task", "run", "labels", "demonstrations", "steps", "share")
MOVING = 0.005  # m per control step


def main() -> None:
    """Adds what the table lacks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--dataset", required=True)
    parser.add_argument("--demonstrations", type=int, default=40, help="the last so many")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    done, write = open_table(options.table, COLUMNS, COLUMNS[:3])
    for path in options.runs:
        trained = load_run(path)
        facts = (trained.task.name, path.name, labels_of(trained.config))
        if facts in done:
            continue
        data = controller_view(load_demonstrations(options.dataset, trained.task), trained.columns)
        last = data["episode"].unique()[-options.demonstrations :]
        decoded, recorded, _ = first_actions(trained.controller, data, last)
        size = recorded.norm(dim=-1)
        moving = size > MOVING
        along = (decoded * recorded).sum(-1)[moving] / size[moving]
        share = float(along.sum() / size[moving].sum())
        write((*facts, len(last), int(moving.sum()), f"{share:.3f}"))
        print(*facts, f"{share:.3f}")


if __name__ == "__main__":
    main()
