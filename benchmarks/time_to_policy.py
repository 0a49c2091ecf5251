# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures success in closed loop by training time; writes ``benchmarks/results/time_to_policy.csv``.

    koap demos --task sorting --episodes 1000 --seed 0 --out runs/sorting-data
    OMP_NUM_THREADS=1 python benchmarks/time_to_policy.py sorting runs/sorting-data --fraction 0.01 --steps 3000 8000

Every number of updates is a separate training with its own learning rate schedule; other options are the task's
defaults. Seconds are those of one core, for planner and controller together. Rollouts use 60 fixed contexts with three
noise seeds each. Rows of the table are not run again.
"""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import torch
import tyro
from tables import open_table
from tyro.conf import Positional

from torchrl_koap import EvalConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig, evaluate, train
from torchrl_koap.tasks import get_task
from torchrl_koap.training.defaults import resolve

RESULTS = Path(__file__).resolve().parent / "results" / "time_to_policy.csv"
KEYS = ("task", "method", "labels", "network", "held_out", "learning_rate", "updates", "seed")
COLUMNS = (*KEYS, "precision", "kept_update", "core_seconds", "successes", "n", "entropy")
ROLLOUTS, PER_CONTEXT = 180, 3


def main(
    task: Positional[str],
    dataset: Positional[Path],
    *,
    steps: tuple[int, ...],
    count: int | None = None,
    fraction: float | None = None,
    method: str | None = None,
    network: str | None = None,
    held_out: float | None = None,
    learning_rate: float | None = None,
    seed: int = 0,
    folder: Path = Path("runs/time_to_policy"),
    results: Path = RESULTS,
) -> None:
    """Trains with each number of updates and rolls each policy out.

    Args:
        task: name of the task.
        dataset: demonstrations of the task.
        steps: maximum numbers of planner updates.
        count: number of labelled trajectories.
        fraction: share of labelled windows, instead of count.
        method: method to train (default: the task's).
        network: network of the planner (default: the task's).
        held_out: share of the trajectories held out to choose the weights (default: the task's).
        learning_rate: peak learning rate of the planner (default: the network's).
        seed: training seed.
        folder: folder of the runs.
        results: the table.
    """
    torch.set_num_threads(1)
    done, write = open_table(results, COLUMNS, KEYS)
    labels = LabelConfig(count=count, fraction=fraction, unit="trajectory" if fraction is None else "window")
    for updates in steps:
        asked = TrainConfig(
            dataset=str(dataset),
            out=folder,
            task=task,
            method=method,
            labels=labels,
            planner=PlannerConfig(steps=updates, network=network, held_out=held_out, learning_rate=learning_rate),
            run=RunConfig(seed=seed, resume=True),
        )
        config = resolve(asked, get_task(task))
        planner = config.planner
        settings = (planner.network, planner.held_out, planner.learning_rate, planner.steps)
        key = (task, config.method, count or fraction, *settings, seed)
        if tuple(map(str, key)) in done:
            continue
        config = replace(config, out=folder / "-".join(map(str, key)))
        began = time.process_time()
        trained = train(config)
        seconds = time.process_time() - began
        again = PER_CONTEXT if trained.task.objects else 1
        score = evaluate(config.out, EvalConfig(episodes=ROLLOUTS, rollouts_per_context=again))
        success = score["rates"]["success"]
        kept = trained.results["planner"].get("kept_update", "")
        successes = round(success["rate"] * success["episodes"])
        entropy = "" if score["mode_entropy"] is None else f"{score['mode_entropy']:.3f}"
        row = (*key, config.run.precision, kept, f"{seconds:.0f}", successes, success["episodes"], entropy)
        write(row)
        print(*row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
