# This source code is licensed under the MIT license found in the LICENSE file.
"""Success in closed loop against training time, written to ``benchmarks/results/time_to_policy.csv``.

    koap demos --task sorting --episodes 1000 --seed 0 --out runs/sorting-data
    OMP_NUM_THREADS=1 python benchmarks/time_to_policy.py sorting runs/sorting-data --fraction 0.01 --steps 3000 8000

Every number of updates is a training of its own, with its own schedule of the learning rate and the task's defaults
for the rest. Seconds are those of one core, for planner and controller together. Rollouts are 60 fixed contexts with
three seeds of noise each. What is in the table is not run again.
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
    """Trains with each number of updates and rolls out.

    Args:
        task: name of the task.
        dataset: its demonstrations.
        steps: updates of the planner, at most.
        count: trajectories whose labels may be seen.
        fraction: share of the windows whose labels may be seen, instead.
        method: what is trained (default: the task's).
        network: network of the planner (default: the task's).
        held_out: share of the trajectories that the weights are chosen by (default: the task's).
        learning_rate: its peak, of the planner (default: the network's).
        seed: of the training.
        folder: where to train.
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
