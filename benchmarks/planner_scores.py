# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures which score of a planner on held-out recordings predicts its success in rollouts.

    python benchmarks/planner_scores.py pusht avoiding_human --seeds 1

Planners differ in network and number of updates. 10 % of the recordings are held out from training and from the choice
of weights. One controller per seed is used with all planners. Appends rows to ``benchmarks/results/planner_scores.csv``
and prints the rank correlation of scores with failures for every ground. ``avoiding_human`` is the set of human
recordings of Avoiding; the other names are those of ``benchmarks/proving_grounds``.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import tyro
from ground_rows import rank_correlations
from proving_grounds.ground import SHARED, Ground
from proving_grounds.run import grounds, roll
from tables import open_table

from torchrl_koap import EvalConfig, LabelConfig, Trained, fit, load_policy
from torchrl_koap.data import cut_windows, open_dataset
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.evaluation.closed_loop import find_environment
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.evaluation.scores import outcome_of
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ExecutionConfig, StatePlanner
from torchrl_koap.modules.planning.energy_score import relative_score, sample_sequences
from torchrl_koap.tasks import HISTORY
from torchrl_koap.tasks.columns import unit_groups
from torchrl_koap.training.datasets import choose_held_out, split_held_out
from torchrl_koap.training.defaults import OWN_TEMPERATURE
from torchrl_koap.training.planner import RECORDED, SAMPLES, SITUATIONS, plan_score

RESULTS = Path(__file__).parent / "results" / "planner_scores.csv"
COLUMNS = ("ground", "seed", "network", "octaves", "updates", "n", "plan_score", "energy_score", "successes")
TRAININGS = (*(("mlp", 0, updates) for updates in (1000, 2000, 3000)), ("mlp", 4, 2000), ("unet", 4, 2000))
HUMAN = "avoiding_human"


def closed_loop(ground: Ground | None, trained: Trained, n: int) -> int:
    """Returns the successes of ``n`` rollouts with the temperature and the single candidate of a user's own data."""
    execution = ExecutionConfig(temperature=OWN_TEMPERATURE)
    if ground is not None:
        return roll(ground, trained, execution, n)["successes"]
    where = find_environment(trained.task, EvalConfig(episodes=n, threads=1))
    policy = load_policy(trained, temperature=OWN_TEMPERATURE, candidates=1)
    episodes = roll_out(policy, where.make_env, list(range(100, 100 + n)), max_steps=where.max_steps, batch_size=n)
    return sum(outcome_of(episode) == "success" for episode in episodes)


def energy(planner: StatePlanner, states: torch.Tensor, trained: Trained) -> float:
    """Returns the energy score of plans on held-out windows, relative to standing still."""
    history, future = planner.split_window(spread_evenly(states, SITUATIONS))
    still, groups = history[:, -1:].expand_as(future), list(unit_groups(trained.task.state_units).values())
    return relative_score(sample_sequences(planner, history, samples=SAMPLES), future, still, groups)


def study(name: str, ground: Ground | None, folder: Path, seed: int, n: int) -> None:
    """Trains and scores the planners that the table lacks for one ground and training seed."""
    done, write = open_table(RESULTS, COLUMNS, COLUMNS[:6])
    missing = [each for each in TRAININGS if tuple(map(str, (name, seed, *each, n))) not in done]
    if not missing:
        return
    source = SHARED.parent / "d3il_avoiding_human" if ground is None else folder / name
    if ground is not None and not (source / "ted").is_dir():
        ground.write(source)
    data, task = open_dataset(source)
    budget = LabelConfig(count=2 if ground is None else ground.labels[0]).budget(seed)
    data, _ = budget.apply(data, command=task.command_columns)
    known, unseen, _ = split_held_out(data, choose_held_out(data, 0.1, seed=seed))
    controlled = fit(data, task, planner=False, seed=seed)
    for network, octaves, updates in missing:
        options = {"network": network, "octaves": octaves, "steps": updates, "held_out": 0.0, "frames": HISTORY}
        planner = fit(known, task, method="linear", planner=options, seed=seed).planner
        length = planner.history + planner.horizon
        windows = [cut_windows(part, length, select=["state"], pad_before=1)["state"] for part in (known, unseen)]
        score = plan_score(planner, unseen, spread_evenly(windows[0], RECORDED), task)(planner)
        trained = replace(controlled, planner=planner)
        row = (name, seed, network, octaves, updates, n, f"{score:.4f}", f"{energy(planner, windows[1], trained):.4f}")
        row += (closed_loop(ground, trained, n),)
        write(row)
        print(*row, flush=True)


def main(
    names: Annotated[tuple[str, ...], tyro.conf.Positional] = ("pusht", HUMAN),
    /,
    *,
    seeds: int = 1,
    n: int = 100,
    folder: Path = Path("runs/proving_grounds"),
) -> None:
    """Runs the cells that the table lacks.

    Args:
        names: proving grounds, and avoiding_human.
        seeds: number of training seeds, from 0.
        n: rollouts per planner.
        folder: data sets of the proving grounds; missing ones are written.
    """
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", 1)))
    known: dict[str, Ground | None] = {**grounds(), HUMAN: None}
    for name in names:
        ground = lookup(known, name, "ground")
        if ground is not None and (ground.env is None or ground.missing()):
            sys.exit(f"{name} has no simulator here: {ground.missing()}")
        for seed in range(seeds):
            study(name, ground, folder.resolve(), seed, n)
    print(rank_correlations())


if __name__ == "__main__":
    tyro.cli(main)
