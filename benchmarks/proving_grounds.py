# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations and simulators of others: the default command of each method, without any tuning.

    python benchmarks/proving_grounds.py --ground pusht --labels 10 --seeds 3

Trains and rolls out every method with every training seed, and appends rows to
``benchmarks/results/proving_grounds.csv``. What is there already is not run again. The planner is that of the first
method. Seconds are those of one core, with the time to read the demonstrations.
"""

from __future__ import annotations

import time
from pathlib import Path
from types import ModuleType
from typing import Literal

import numpy as np
import pusht
import torch
import tyro
from tables import open_table

from torchrl_koap import LabelConfig, PlannerConfig, RunConfig, TrainConfig, load_policy, train
from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.training.methods import METHODS, get_method

RESULTS = Path(__file__).resolve().parent / "results" / "proving_grounds.csv"
GROUNDS: dict[str, ModuleType] = {"pusht": pusht}
KEYS = ("ground", "method", "labels", "seed", "execution", "n")
COLUMNS = (
    *KEYS,
    "largest_reward",
    "standard_error",
    "successes",
    "held_out_score",
    "kept_update",
    "train_core_seconds",
)


def run_cell(
    ground: str,
    method: str,
    labels: int,
    seed: int,
    executions: dict[str, ExecutionConfig],
    n: int,
    folder: Path,
    source: Path | None = None,
) -> list[tuple[object, ...]]:
    """Trains one method and rolls it out in each way to execute plans; ``source`` is a run whose planner it shares."""
    here = GROUNDS[ground]
    dataset = folder / ground
    if not dataset.is_dir():
        here.write_data_set(dataset)
    plans = get_method(method).plans
    began = time.process_time()
    trained = train(
        TrainConfig(
            dataset=str(dataset),
            out=run_folder(folder, ground, method, labels, seed),
            method=method,
            labels=LabelConfig(count=labels),
            planner=PlannerConfig(source=source if plans else None),
            run=RunConfig(seed=seed, resume=True),
        )
    )
    seconds = time.process_time() - began
    rows = []
    for name, execution in executions.items():
        episodes = roll_out(
            load_policy(trained, **{k: v for k, v in vars(execution).items() if v is not None}),
            lambda count: GymnasiumBatch(here.ENV, trained.task, count, max_steps=here.STEPS),
            list(range(here.FIRST_SEED, here.FIRST_SEED + n)),
            max_steps=here.STEPS,
            batch_size=25,
        )
        rewards = np.array([episode["next", "reward"].max().item() for episode in episodes])
        planner = trained.results["planner" if plans else "controller"]
        score = planner.get("best_held_out_score")
        rows.append(
            (
                *(ground, method, labels, seed, name, n),
                f"{rewards.mean():.4f}",
                f"{rewards.std() / n**0.5:.4f}",
                int((rewards >= 0.999).sum()),
                "" if score is None else f"{score:.4f}",
                planner.get("kept_update", ""),
                f"{seconds:.0f}",
            )
        )
    return rows


def run_folder(folder: Path, ground: str, method: str, labels: int, seed: int) -> Path:
    """Where a cell is trained."""
    return folder / f"{ground}-{method}-{labels}-{seed}"


def main(
    *,
    ground: Literal["pusht"] = "pusht",
    methods: tuple[str, ...] = ("koap", "koap_untrained", "linear_steps", "dp"),
    labels: int = 10,
    seeds: int = 3,
    n: int = 150,
    folder: Path = Path("runs/proving_grounds"),
    results: Path = RESULTS,
) -> None:
    """Runs the cells that the table lacks.

    Args:
        ground: whose demonstrations and simulator.
        methods: what is compared; the first one plans, and the others share its planner.
        labels: demonstrations whose actions may be seen.
        seeds: number of training seeds, from 0.
        n: rollouts per cell, with the seeds from the ground's first one on.
        folder: where to train.
        results: the table.
    """
    lookup([name for name in METHODS if get_method(name).plans], methods[0], "first method, which plans")
    torch.set_num_threads(1)
    done, write = open_table(results, COLUMNS, KEYS)
    executions = {"default": ExecutionConfig(), "open_loop_8": ExecutionConfig(strategy="open_loop", replan_interval=8)}
    for seed in range(seeds):
        for method in methods:
            cell = (ground, method, labels, seed)
            ways = executions if get_method(method).plans else {"default": ExecutionConfig()}  # sampled actions
            asked = {name: way for name, way in ways.items() if tuple(map(str, (*cell, name, n))) not in done}
            first = run_folder(folder, ground, methods[0], labels, seed)
            for row in run_cell(*cell, asked, n, folder, None if method == methods[0] else first) if asked else ():
                write(row)
                print(*row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
