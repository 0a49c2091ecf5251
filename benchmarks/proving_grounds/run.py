# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs every method with default options on external demonstrations and simulators (proving grounds).

    python benchmarks/proving_grounds/run.py pusht --labels 10 --seeds 3
    python benchmarks/proving_grounds/run.py  # every ground whose packages and data exist

Trains and scores every method with every training seed; appends rows to ``benchmarks/results/proving_grounds.csv``.
Rows of the table are not run again. All methods share the planner of the first method. Seconds are those of one core.
A ground is defined in ``GROUNDS`` of a file in this folder.
"""

from __future__ import annotations

import importlib
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))

from proving_grounds.ground import Ground  # noqa: E402
from tables import open_table  # noqa: E402

from torchrl_koap import (  # noqa: E402
    EvalConfig,
    LabelConfig,
    PlannerConfig,
    RunConfig,
    TrainConfig,
    Trained,
    evaluate,
    load_policy,
    train,
)
from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch  # noqa: E402
from torchrl_koap.evaluation.rollouts import roll_out  # noqa: E402
from torchrl_koap.keys import SUCCESS  # noqa: E402
from torchrl_koap.lookup import lookup  # noqa: E402
from torchrl_koap.modules import ExecutionConfig  # noqa: E402
from torchrl_koap.training.methods import get_method  # noqa: E402
from torchrl_koap.vision.observer import Observer  # noqa: E402

RESULTS = HERE.parent / "results" / "proving_grounds.csv"
FIRST_SEED = 100_000
KEYS = ("ground", "method", "labels", "seed", "execution", "n")
SCORES = ("largest_reward", "standard_error", "successes", "plan_error", "action_error")
COLUMNS = (*KEYS, *SCORES, "held_out_score", "kept_update", "train_core_seconds")
EXECUTIONS = {
    "default": ExecutionConfig(),
    "open_loop_8": ExecutionConfig(strategy="open_loop", replan_interval=8),
    "temperature_1": ExecutionConfig(temperature=1.0),
}


def grounds() -> dict[str, Ground]:
    """Returns every proving ground by name."""
    found: dict[str, Ground] = {}
    for file in sorted(HERE.glob("*.py")):
        if file.stem not in ("run", "ground"):
            found |= importlib.import_module(f"proving_grounds.{file.stem}").GROUNDS
    return found


def roll(
    ground: Ground, trained: Trained, execution: ExecutionConfig, n: int, *, first_seed: int = FIRST_SEED
) -> dict[str, Any]:
    """Rolls a policy out in the simulator of a ground; returns columns of the table."""
    observe = Observer(trained.task, trained.cameras) if trained.cameras else None
    episodes = roll_out(
        load_policy(trained, **{key: value for key, value in vars(execution).items() if value is not None}),
        lambda count: GymnasiumBatch(ground.env, trained.task, count, observe=observe, max_steps=ground.max_steps),
        list(range(first_seed, first_seed + n)),
        max_steps=ground.max_steps,
        batch_size=25,
    )
    if ground.score == "success":
        return {"successes": sum(bool(episode["next", SUCCESS].any()) for episode in episodes)}
    rewards = np.array([episode["next", "reward"].max().item() for episode in episodes])
    return {
        "largest_reward": f"{rewards.mean():.4f}",
        "standard_error": f"{rewards.std() / n**0.5:.4f}",
        "successes": int((rewards >= 0.999).sum()),
    }


def judge(trained: Trained) -> dict[str, Any]:
    """Scores a run on recordings: plan error relative to standing still, action error relative to the ridge."""
    result = evaluate(trained.folder, EvalConfig(threads=1))
    action = result["action_errors"]["outside_budget"]  # both errors are relative to that of the mean action
    errors = {
        "plan_error": result["relative_plan_error"],
        "action_error": action["relative"] / action["ridge_relative"],
    }
    return {name: "" if error is None else f"{error:.4f}" for name, error in errors.items()}


def run_cell(
    name: str, ground: Ground, config: TrainConfig, executions: dict[str, ExecutionConfig], n: int
) -> list[tuple[object, ...]]:
    """Trains one method and scores it with each execution; returns the rows."""
    began = time.process_time()
    trained = train(config)
    seconds = time.process_time() - began
    part = trained.results["planner" if get_method(config.method).plans else "controller"]
    held_out, kept = part.get("best_held_out_score"), part.get("kept_update")
    rows = []
    for way, execution in executions.items():
        row = {"ground": name, "method": config.method, "labels": config.labels.count, "seed": config.run.seed}
        row |= {"execution": way, "n": n}
        row |= judge(trained) if ground.env is None else roll(ground, trained, execution, n)
        row["held_out_score"] = "" if held_out is None else f"{held_out:.4f}"
        row |= {"kept_update": "" if kept is None else int(kept), "train_core_seconds": f"{seconds:.0f}"}
        rows.append(tuple(row.get(column, "") for column in COLUMNS))
    return rows


def main(
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = (),
    /,
    *,
    methods: tuple[str, ...] = ("koap", "koap_untrained", "linear_steps", "dd_lookahead", "dd", "dp"),
    labels: tuple[int, ...] | None = None,
    seeds: int = 3,
    executions: tuple[str, ...] = ("default",),
    n: int | None = None,
    steps: int | None = None,
    folder: Path = Path("runs/proving_grounds"),
    results: Path = RESULTS,
) -> None:
    """Runs the cells that the table lacks.

    Args:
        names: grounds. Default: all.
        methods: methods to compare; those that plan share the planner of the first one that plans.
        labels: numbers of labelled demonstrations. Default: the ground's own.
        seeds: number of training seeds, from 0.
        executions: executions of plans: default, open_loop_8, temperature_1.
        n: rollouts per cell, with the seeds from 100,000 on. Default: the ground's own.
        steps: maximum updates of planners and Diffusion Policy; use another folder and table for them. Default: the
            library's.
        folder: folder of the runs.
        results: the table.
    """
    known = grounds()
    try:
        asked = {name: lookup(known, name, "proving ground") for name in names or known}
        for method in methods:
            get_method(method)
        ways = {name: lookup(EXECUTIONS, name, "execution") for name in executions}
    except ValueError as error:
        sys.exit(str(error))
    torch.set_num_threads(1)
    folder = folder.resolve()  # runs store the path of their data set
    done, write = open_table(results, COLUMNS, KEYS)
    planning = [method for method in methods if get_method(method).plans]
    for name, ground in asked.items():
        if missing := ground.missing():
            print(f"{name} is skipped: {missing}")
            continue
        runs = ground.runs_of or name
        for seed in range(seeds):
            for count in labels or ground.labels:
                trials = (n or ground.n) - count * (ground.env is None)
                for method in methods:
                    cell = (name, method, count, seed)
                    own = ways if get_method(method).plans else {"default": EXECUTIONS["default"]}  # no plans
                    own = {way: each for way, each in own.items() if tuple(map(str, (*cell, way, trials))) not in done}
                    if not own:
                        continue
                    if not (folder / runs / "ted").is_dir():
                        ground.write(folder / runs)
                    takes = method in planning[1:]
                    config = TrainConfig(
                        dataset=str(folder / runs),
                        out=folder / f"{runs}-{method}-{count}-{seed}",
                        method=method,
                        labels=LabelConfig(count=count),
                        planner=PlannerConfig(
                            source=folder / f"{runs}-{planning[0]}-{count}-{seed}" if takes else None,
                            steps=None if takes else steps,
                        ),
                        run=RunConfig(seed=seed, resume=True),
                    )
                    for row in run_cell(name, ground, config, own, trials):
                        write(row)
                        print(*row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
