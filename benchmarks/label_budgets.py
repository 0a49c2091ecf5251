# This source code is licensed under the MIT license found in the LICENSE file.
"""Action error and closed-loop success against the number of labels, with one shared planner.

    python benchmarks/label_budgets.py --dataset DIR --planner RUN --counts 1 2 48 --out runs/budgets

Every cell is a `koap train --planner-from RUN` and a `koap eval`; finished cells are not done again. Action errors are
means over the seeds with their range; successes are pooled over the seeds with a 95 % Wilson interval.
"""

from __future__ import annotations

import argparse
import json
import statistics
from pathlib import Path

from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.statistics import mode_entropy, wilson_interval
from torchrl_koap.training import TrainConfig, train


def run_cell(arguments: argparse.Namespace, method: str, count: int, seed: int) -> dict:
    """Trains and evaluates one cell, or reads it if it is there."""
    out = arguments.out / f"{method.replace(':', '-')}-{count}-{seed}"
    name, _, preset = method.partition(":")
    if not (out / "summary.json").exists():
        train(
            TrainConfig(
                out=out,
                dataset=arguments.dataset,
                label_count=count,
                seed=seed,
                method=name,
                preset=preset or "default",
                planner_from=arguments.planner,
                threads=arguments.threads,
                resume=(out / "config.json").exists(),
            )
        )
    if arguments.episodes and not (out / "eval.json").exists():
        evaluate(out, EvalConfig(episodes=arguments.episodes, seed=1000 * seed, threads=arguments.threads))
    cell = json.loads((out / "summary.json").read_text())
    if arguments.episodes:
        cell["eval"] = json.loads((out / "eval.json").read_text())
    return cell


def row(method: str, count: int, cells: list[dict]) -> str:
    """One line of the table."""
    errors = [cell["action_error_mm"]["controller"] for cell in cells]
    ridge = statistics.fmean(cell["action_error_mm"]["ridge"] for cell in cells)
    text = (
        f"{method:<14}{count:>6}  {statistics.fmean(errors):6.3f} ({min(errors):.3f}-{max(errors):.3f})  {ridge:6.3f}"
    )
    if "eval" not in cells[0]:
        return text
    episodes = [episode for cell in cells for episode in cell["eval"]["episode"]]
    won = [episode for episode in episodes if episode["outcome"] == "success"]
    low, high = wilson_interval(len(won), len(episodes))
    entropy = statistics.fmean(cell["eval"]["mode_entropy"] for cell in cells)
    pooled = mode_entropy([episode["mode"] for episode in won if episode["mode"] >= 0], 24)
    return (
        f"{text}  {len(won):>4}/{len(episodes):<4} {len(won) / len(episodes):6.1%} ({low:.1%}-{high:.1%})"
        f"  {entropy:.3f} ({pooled:.3f})"
    )


def main() -> None:
    """Runs all cells and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--dataset", default="scripted")
    parser.add_argument("--planner", type=Path, required=True, help="run directory whose planner all cells share")
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 48], help="labelled trajectories")
    parser.add_argument("--methods", nargs="+", default=["koap", "linear", "dd"], help="koap:paper is a preset")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--episodes", type=int, default=60, help="0: action errors only")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rows = []
    for count in arguments.counts:
        for method in arguments.methods:
            cells = [run_cell(arguments, method, count, seed) for seed in range(arguments.seeds)]
            rows.append(row(method, count, cells))
    print(
        f"{'method':<14}{'labels':>6}  {'error mm (range)':<21}  {'ridge':>6}  {'success (95 %)':<32}  entropy (pooled)"
    )
    print("\n".join(rows))


if __name__ == "__main__":
    main()
