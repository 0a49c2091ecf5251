# This source code is licensed under the MIT license found in the LICENSE file.
"""Scores executions and numbers of updates for each method, on demonstrations that no table uses.

    koap demos --task avoiding --episodes 96 --seed 7 --out runs/tuning_avoiding
    python benchmarks/tune_methods.py avoiding runs/tuning_avoiding --labels 0.02 0.1
    python benchmarks/tune_methods.py pusht runs/tuning_pusht --labels 10  # writes the first hundred demonstrations

The defaults of methods (:class:`~torchrl_koap.training.Method`) are chosen by these rows. All methods of a task share
one planner. The score is the success rate on Avoiding, with seeds that no table uses, and the mean largest reward on
Push-T. Rows of the table are not run again.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Literal

import torch
import tyro
from proving_grounds import pusht
from proving_grounds.run import roll
from tables import open_table
from tyro.conf import Positional

from torchrl_koap import (
    ControllerConfig,
    EvalConfig,
    LabelConfig,
    PlannerConfig,
    RunConfig,
    TrainConfig,
    Trained,
    evaluate,
    train,
)
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.training.methods import get_method

RESULTS = Path(__file__).resolve().parent / "results" / "method_tuning.csv"
KEYS = ("task", "method", "updates", "labels", "execution")
COLUMNS = (*KEYS, "score", "n", "train_core_seconds")
EXECUTIONS = {
    "feedback": ExecutionConfig(strategy="feedback"),
    "open_loop": ExecutionConfig(strategy="open_loop"),
    "open_loop_as_planned": ExecutionConfig(strategy="open_loop", blend=0.0),
    "open_loop_8": ExecutionConfig(strategy="open_loop", replan_interval=8),
}
N, AVOIDING_SEED, PUSHT_SEED = 60, 5000, 500_000  # rollouts, and their first seeds
METHODS = (
    *("koap", "koap_untrained", "koap_labelled_only", "koap_sgd", "koap_paper", "linear_steps", "pca", "linear"),
    *("dd", "dd_lookahead", "vae", "lapo", "nonlinear", "pretrain"),
)


def score(task: str, trained: Trained, execution: ExecutionConfig) -> float:
    """Rolls a policy out; returns the success rate on Avoiding, the mean largest reward on Push-T."""
    if task == "pusht":
        result = roll(pusht.GROUNDS["pusht"], trained, execution, N, first_seed=PUSHT_SEED)
        return float(result["largest_reward"])
    config = EvalConfig(episodes=N, seed=AVOIDING_SEED, execution=execution, out=trained.folder / "evaluation")
    return float(evaluate(trained.folder, config)["rates"]["success"]["rate"])


def main(
    task: Positional[Literal["avoiding", "pusht"]],
    dataset: Positional[Path],
    *,
    labels: tuple[float, ...],
    methods: tuple[str, ...] = METHODS,
    updates: tuple[int, ...] = (300, 1000, 4000),
    folder: Path = Path("runs/tuning"),
    results: Path = RESULTS,
) -> None:
    """Trains each method with each number of updates and scores it with each execution.

    Args:
        task: task to tune on.
        dataset: demonstrations of the task; those of Push-T are written if they do not exist.
        labels: share of labelled windows (below 1) or number of labelled demonstrations.
        methods: methods to train.
        updates: controller updates; methods fitted in closed form alone use the first.
        folder: folder of the runs.
        results: the table.
    """
    torch.set_num_threads(1)
    done, write = open_table(results, COLUMNS, KEYS)
    if task == "pusht" and not dataset.exists():
        pusht.write_data_set(dataset, demonstrations=100)
    ways = {name: way for name, way in EXECUTIONS.items() if task == "pusht" or name != "open_loop_8"}
    common = {"task": task if task == "avoiding" else None, "dataset": str(dataset.resolve())}
    run = RunConfig(seed=0, resume=True)
    for part in labels:
        known = LabelConfig(fraction=part, unit="window") if part < 1 else LabelConfig(count=int(part))
        first = folder.resolve() / f"{task}-planner"
        for method in methods:
            for number in updates if get_method(method).phases else updates[:1]:
                key = (task, method, number, f"{part:g}")
                todo = {name: way for name, way in ways.items() if tuple(map(str, (*key, name))) not in done}
                if not todo:
                    continue
                if not (first / "summary.json").exists():
                    train(TrainConfig(**common, out=first, method="linear_steps", labels=known, run=run))
                began = time.process_time()
                trained = train(
                    TrainConfig(
                        **common,
                        out=folder.resolve() / "-".join(map(str, key)),
                        method=method,
                        labels=known,
                        planner=PlannerConfig(source=first),
                        controller=ControllerConfig(steps=number),
                        run=run,
                    )
                )
                seconds = f"{time.process_time() - began:.1f}"
                for name, way in todo.items():
                    write((*key, name, f"{score(task, trained, way):.4f}", N, seconds))


if __name__ == "__main__":
    tyro.cli(main)
