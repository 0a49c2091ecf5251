# This source code is licensed under the MIT license found in the LICENSE file.
"""How long a curve of thousands of cells takes to find out what is missing, with training and rollouts left out.

    python benchmarks/curve_resume.py --write

Cells get the files that a real one leaves, of made-up content; everything else (locks, checks, reading, the table,
paired comparisons, plots and the page) is what ``koap curve`` does. The first call makes all cells, the second finds
all of them done, the third one finds ``--missing`` of them gone. A call goes on with its cells after ``begins_after``
seconds; plots and page come when they are through.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

from torchrl_koap.studies import curve_table, label_efficiency
from torchrl_koap.studies.label_efficiency import ALL, CurveConfig, run_curve
from torchrl_koap.studies.launchers import Job

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from tiny_runs import write_demonstrations  # noqa: E402

TABLE = Path(__file__).parent / "results" / "curve_resume.csv"
COLUMNS = ("call", "cells", "missing", "begins_after", "seconds", "cells_read", "command")
EPISODES = 60


def finish(folder: Path, cell: dict[str, Any], evaluation: dict[str, Any]) -> None:
    """The files of a cell that was trained and evaluated."""
    folder.mkdir(parents=True, exist_ok=True)
    successes = random.Random(str(cell)).randrange(20, EPISODES)
    labels = {"selected_units": 1, "labelled_transitions": 20, "trajectories_touched": 1}
    rate = successes / EPISODES
    result = {
        **{"episodes": EPISODES, "success_rate": rate, "success_low": rate - 0.1, "success_high": rate + 0.1},
        **{"mode_entropy": 0.5, "collisions": 2, "mean_steps": 70.5},
        "episode": [
            {"seed": seed, "outcome": "success" if seed < successes else "timeout", "mode": seed % 24, "steps": 70}
            for seed in range(EPISODES)
        ],
    }
    done = cell | {"labels": labels, "train_seconds": 1.0, "eval_seconds": 1.0, "episodes": EPISODES}
    files = {
        "summary.json": {"controller_updates": 1000, "action_error_mm": {"controller": 1.0}},
        "eval.json": result,
        "cell.json": done | {"successes": successes},
    }
    for name, content in files.items():
        (folder / name).write_text(json.dumps(content))


STARTED: list[float] = []


def stub(jobs: Sequence[Job], **options: Any) -> Iterator[tuple[Job, str | None]]:
    """Takes the place of the launcher: every job leaves its files at once."""
    STARTED.append(time.perf_counter())
    for job in jobs:
        if "cell" in job.arguments:
            finish(Path(job.arguments["folder"]), job.arguments["cell"], job.arguments["evaluation"])
        yield job, None


def main() -> None:
    """Three calls, timed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=40, help="ten methods and five fractions with so many seeds")
    parser.add_argument("--missing", type=int, default=20, help="cells that the third call has to do again")
    parser.add_argument("--write", action="store_true", help=f"write {TABLE.name}")
    options = parser.parse_args()
    torch.set_num_threads(1)
    label_efficiency.launch = stub
    reads, original = [], curve_table.cell_row

    def counted(root: Path, cell: Any, **more: Any) -> dict[str, Any]:
        reads.append(cell)
        return original(root, cell, **more)

    curve_table.cell_row = counted
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        data = write_demonstrations(Path(folder) / "data", episodes=100)
        config = CurveConfig(
            out=Path(folder) / "curve",
            dataset=str(data),
            methods=ALL,
            seeds=options.seeds,
            episodes=EPISODES,
            workers=1,
        )
        for call in ("all cells to do", "none", "a few"):
            gone = sorted((config.out / "cells").glob("*-seed0"))[: options.missing] if call == "a few" else []
            for path in gone:
                shutil.rmtree(path)
            reads.clear()
            began = time.perf_counter()
            result = run_curve(config)
            seconds, begins = time.perf_counter() - began, STARTED[-1] - began
            missing = result["done"] if not rows else len(gone)
            command = f"python benchmarks/curve_resume.py --seeds {options.seeds} --missing {options.missing} --write"
            values = (call, result["done"], missing, f"{begins:.1f}", f"{seconds:.1f}", len(reads), command)
            rows.append(dict(zip(COLUMNS, values, strict=True)))
            print(" ".join(f"{name} {value}" for name, value in rows[-1].items() if name != "command"), flush=True)
    if options.write:
        with TABLE.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    main()
