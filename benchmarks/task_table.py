# This source code is licensed under the MIT license found in the LICENSE file.
"""Success on the D3IL tasks at two label levels, KOAP against supervised inverse dynamics (dd), one planner per seed.

    python benchmarks/task_table.py --out runs/table --tasks aligning sorting po_sorting stacking --seeds 0 1 2

Every cell is a run directory of its own, evaluated on the 60 fixed contexts; finished cells are not done again. The
planner of a task and seed is trained once and shared by all its cells. Rows pool the seeds; intervals are Wilson's.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.studies.paper_results import paper_success
from torchrl_koap.tasks import get_task

LEVELS = (1, 5)
METHODS = ("koap", "dd")


def koap(*arguments: object) -> None:
    """Runs a command of the library in a process of its own."""
    subprocess.run(
        [sys.executable, "-m", "torchrl_koap.commands.cli", *map(str, arguments)], check=True, stdout=sys.stderr
    )


def cell(options: argparse.Namespace, task: str, seed: int, level: int, method: str, planner: Path | None) -> Path:
    """Trains and evaluates one cell if that has not been done yet; returns its folder."""
    run = options.out / f"{task}-{seed}-level{level}-{method}"
    if (run / "eval.json").exists():
        return run
    demos = options.out / f"demos-{get_task(task).source}"
    if not (demos / "ted").exists():
        koap("demos", "--task", get_task(task).source, "--out", demos, "--episodes", options.demonstrations)
    start = time.perf_counter()
    if not (run / "summary.json").exists():
        share = get_task(task).label_levels[level - 1]
        words = ["train", "--task", task, "--dataset", demos, "--label-fraction", share, "--label-unit", "window"]
        words += ["--seed", seed, "--method", method, "--out", run, "--no-analysis"]
        words += [] if planner is None else ["--planner-from", planner]
        words += ["--steps", options.steps] if options.steps and planner is None else []
        words += ["--resume"] if (run / "config.json").exists() else []
        koap(*words)
    koap("eval", run, "--episodes", options.episodes, "--threads", 1, "--no-animate")
    (run / "seconds.txt").write_text(f"{time.perf_counter() - start:.0f}\n")
    return run


def row(runs: list[Path], metric: str = "success") -> str:
    """Successes of several runs together, with their interval."""
    results = [json.loads((run / "eval.json").read_text()) for run in runs]
    total = sum(result["episodes"] for result in results)
    good = sum(round(result[f"{metric}_rate"] * result["episodes"]) for result in results)
    low, high = wilson_interval(good, total)
    return f"{100 * good / total:.1f} ({100 * low:.1f}-{100 * high:.1f}), n = {total}"


def per_cent(share: float | None) -> str:
    """A share as a whole number of per cent; nothing if it is not known."""
    return "" if share is None else f"{100 * share:.0f}"


def main() -> None:
    """Does the cells, prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", default=["aligning", "sorting", "po_sorting", "stacking"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--demonstrations", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--steps", type=int, help="planner updates (default: that of the task)")
    parser.add_argument("--only-print", action="store_true", help="print what is there")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    print("| task | level | method | success % (95 %) | pooled mode entropy | paper % | seconds per cell |")
    print("|---|---|---|---|---|---|---|")
    for task in options.tasks:
        cells: dict[tuple[int, str], list[Path]] = {}
        for seed in options.seeds:
            planner = None
            for method in METHODS:
                for level in LEVELS:
                    run = options.out / f"{task}-{seed}-level{level}-{method}"
                    if not options.only_print:
                        run = cell(options, task, seed, level, method, planner)
                    planner = planner or run
                    if (run / "eval.json").exists():
                        cells.setdefault((level, method), []).append(run)
        for (level, method), runs in sorted(cells.items()):
            results = [json.loads((run / "eval.json").read_text()) for run in runs]
            entropy = [result.get("pooled_mode_entropy", result.get("mode_entropy")) or 0.0 for result in results]
            seconds = "/".join(
                (run / "seconds.txt").read_text().strip() for run in runs if (run / "seconds.txt").exists()
            )
            paper = per_cent(paper_success(task, "koap", level))
            mean = sum(entropy) / len(entropy)
            print(f"| {task} | {level} | {method} | {row(runs)} | {mean:.2f} | {paper} | {seconds} |", flush=True)
            for count in (1, 2) if task == "stacking" else ():
                known = per_cent(paper_success("stacking_1", "koap", level)) if count == 1 else ""
                boxes = row(runs, f"stacked_{count}")
                print(f"| {task}, {count} of 3 boxes | {level} | {method} | {boxes} | | {known} | |")


if __name__ == "__main__":
    main()
