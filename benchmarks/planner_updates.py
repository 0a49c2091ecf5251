# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures which planner suits more and fewer recordings: Aligning as if it were a user's own data.

    koap demos --task aligning --episodes 1000 --disturbance 0.5 --out runs/aligning1000
    python benchmarks/planner_updates.py runs/aligning1000
    python benchmarks/planner_updates.py runs/aligning1000 --demonstrations 1000 --updates 12000 --octaves 4

The data sets hold the numbers that the simulator observes, 20 labelled demonstrations and no definition of the task.
Rows of the table are not run again. ``torchrl_koap/data/planner_choices.py`` chooses updates by these rows.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import tyro
from tables import open_table
from tyro.conf import Positional

from torchrl_koap import EvalConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig, evaluate, train
from torchrl_koap.data import open_dataset, save_demonstrations

RESULTS = Path(__file__).resolve().parent / "results" / "planner_updates.csv"
KEYS = ("demonstrations", "network", "octaves", "updates", "seed", "n")
COLUMNS = (*KEYS, "successes", "held_out_score", "kept_update")
ENV, LABELLED, N, FIRST_SEED = "torchrl_koap/Aligning-v0", 20, 100, 1000


def write_own_data(folder: Path, recorded: Path, number: int) -> None:
    """Writes some recorded demonstrations of Aligning, drawn at random, as a user would."""
    data, task = open_dataset(recorded)
    names = [f"{part}_{axis}" for part, size in task.observation_parts.items() for axis in range(size)]
    chosen = np.random.default_rng(0).permutation(data["episode"].unique().numpy())[:number]
    kept = [data[data["episode"] == episode] for episode in sorted(chosen.tolist())]
    save_demonstrations(
        folder,
        [part["observation"].double().numpy() for part in kept],
        [part["action"].double().numpy() for part in kept],
        control_hz=task.control_hz,
        state_names=names,
        command=[name for name in names if name.startswith(task.command)],
        robot=[name for name in names if name.startswith(task.position)],
        max_steps=task.max_steps,
    )


def main(
    dataset: Positional[Path],
    *,
    demonstrations: tuple[int, ...] = (300, 1000),
    updates: tuple[int, ...] = (3000, 6000, 12_000),
    network: str = "mlp",
    octaves: int = 0,
    seed: int = 0,
    folder: Path = Path("runs/planner_updates"),
    results: Path = RESULTS,
) -> None:
    """Trains KOAP with each number of updates on each number of demonstrations and rolls it out.

    Args:
        dataset: recorded demonstrations of Aligning.
        demonstrations: numbers of demonstrations.
        updates: most updates of the planner.
        network: network of the planner.
        octaves: octaves of its Fourier features.
        seed: training seed.
        folder: folder of data sets and runs.
        results: the table.
    """
    torch.set_num_threads(1)
    done, write = open_table(results, COLUMNS, KEYS)
    for number in demonstrations:
        own = folder.resolve() / f"data_{number}"
        for most in updates:
            key = (number, network, octaves, most, seed, N)
            if tuple(map(str, key)) in done:
                continue
            if not own.exists():
                write_own_data(own, dataset, number)
            config = TrainConfig(
                dataset=str(own),
                out=folder.resolve() / "-".join(map(str, key[:5])),
                labels=LabelConfig(count=LABELLED),
                planner=PlannerConfig(steps=most, network=network, octaves=octaves),
                run=RunConfig(seed=seed, resume=True),
            )
            trained = train(config)
            result = evaluate(trained.folder, EvalConfig(env=ENV, episodes=N, seed=FIRST_SEED))
            successes, found = round(result["rates"]["success"]["rate"] * N), trained.results["planner"]
            write((*key, successes, f"{found['best_held_out_score']:.4f}", int(found["kept_update"])))


if __name__ == "__main__":
    tyro.cli(main)
