# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures how demonstrations of another embodiment affect success on Scooping from pixels.

    python benchmarks/scooping.py --folder runs/scooping
    python benchmarks/scooping.py --folder runs/scooping --methods koap linear dd --labels 2 5 20 --unlabelled both
    python benchmarks/scooping.py --folder runs/moving --task scooping_moving_bowl

Records robot and hand, embeds the frames, trains one planner per set of unlabelled demonstrations and one controller
per cell, and rolls each out. Folders and rows of the table that exist are not made again.

Unlabelled demonstrations are those of the robot, of the hand, both, or none. With the hand or none, only labelled
demonstrations of the robot are used. The robot's first ones are labelled; they begin at the three starts in turn.
"""

from __future__ import annotations

import shutil
from itertools import product
from pathlib import Path
from typing import Literal

import tyro
from tables import open_table

from torchrl_koap import ControllerConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig, train
from torchrl_koap.data import read_recordings
from torchrl_koap.envs.scooping.expert import HABITS
from torchrl_koap.envs.scooping.recording import record_videos
from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.tasks import get_task
from torchrl_koap.tasks.scooping import CAMERA
from torchrl_koap.training.methods import METHODS as KNOWN
from torchrl_koap.training.methods import get_method
from torchrl_koap.vision.embedding import embed_recordings, join_recordings, read_sources
from torchrl_koap.vision.encoder import SCOOPING, Projection, projection_of

RESULTS = Path(__file__).parent / "results"
Task = Literal["scooping", "scooping_moving_bowl"]
Unlabelled = Literal["robot", "hand", "both", "none"]
NETWORK = Projection.load(SCOOPING).about["network"]
FEW_ROBOTS = ("hand", "none")  # sets in which all demonstrations of the robot are labelled
METHODS = ("koap", "koap_paper", "dd", "vae", "lapo", "dp", "pca", "linear")
KEYS = ("labels", "unlabelled", "method", "seed", "n")
COLUMNS = (*KEYS, "successes", "rims", "left", "near", "right", "action_error_mrad")


def data_set(folder: Path, unlabelled: str, labels: int, task: str = "scooping") -> Path:
    """Returns the data set of a cell; embeds it if it does not exist."""
    out = folder / f"data_{_name(unlabelled, labels)}"
    if not (out / "ted").is_dir():
        few = range(labels) if unlabelled in FEW_ROBOTS else ()
        sources = [read_recordings(folder / "robot", episodes=few)]
        if unlabelled not in ("robot", "none"):
            sources.append(read_recordings(folder / "hand", action_dim=get_task(task).action_dim))
        projection = Projection.load(projection_of(task))
        embed_recordings(join_recordings(sources), get_task(task), out, projection=projection)
    return out


def _name(unlabelled: str, labels: int) -> str:
    """Names a set of unlabelled demonstrations, with the number of labels if the set depends on it."""
    return f"{unlabelled}_{labels}" if unlabelled in FEW_ROBOTS else unlabelled


def run_cell(
    folder: Path,
    task: str,
    unlabelled: str,
    labels: int,
    method: str,
    seed: int,
    *,
    steps: int,
    controller_steps: int,
    evaluation: EvalConfig,
) -> tuple[object, ...]:
    """Trains and rolls out one cell; trains its shared planner if that does not exist."""
    dataset = str(data_set(folder, unlabelled, labels, task))
    planner = PlannerConfig(steps=steps, held_out=0.0)  # every demonstration trains the planner, as in all rows
    if get_method(method).plans:
        source = folder / f"planner_{_name(unlabelled, labels)}_{seed}"
        if not (source / "planner.safetensors").is_file():
            run = RunConfig(seed=seed, resume=source.exists())
            config = TrainConfig(out=source, task=task, dataset=dataset, planner=planner, run=run)
            train(config, planner_only=True)
        planner = PlannerConfig(source=source)
    out = folder / f"{method}_{unlabelled}_{labels}_{seed}"
    if not (out / "summary.json").is_file():
        config = TrainConfig(
            out=out,
            task=task,
            dataset=dataset,
            method=method,
            labels=LabelConfig(episodes=tuple(range(labels))),
            planner=planner,
            controller=ControllerConfig(steps=controller_steps),
            run=RunConfig(seed=seed, resume=out.exists()),
        )
        train(config)
    result, n = evaluate(out, evaluation), evaluation.episodes
    rates = result["rates"]
    counts = (round(rates[name]["rate"] * n) for name in ("success", "spoon over the bowl"))
    starts = (f"{rates[f'success from {start}']['rate']:.3f}" for start in ("left", "near", "right"))
    split = result["action_errors_on"]
    error = f"{1e3 * result['action_errors'][split]['unit'][0]['controller']:.1f}" if split else ""
    return (labels, unlabelled, method, seed, n, *counts, *starts, error)


def main(
    *,
    folder: Path,
    task: Task = "scooping",
    demonstrations: int = 100,
    methods: tuple[str, ...] = METHODS,
    labels: tuple[int, ...] = (5, 2, 20),
    unlabelled: tuple[Unlabelled, ...] = ("robot", "hand", "both", "none"),
    seeds: tuple[int, ...] = (0,),
    episodes: int = 15,
    steps: int = 2000,
    controller_steps: int = 200,
    fit: bool = False,
    results: Path = RESULTS,
) -> None:
    """Runs the cells that the table of the task lacks.

    Args:
        folder: folder for recordings, embeddings and runs.
        task: task; use another folder for each.
        demonstrations: number of demonstrations per embodiment.
        methods: methods to compare.
        labels: numbers of labelled demonstrations.
        unlabelled: embodiments of the unlabelled demonstrations.
        seeds: training seeds.
        episodes: rollouts per cell.
        steps: planner updates.
        controller_steps: controller updates.
        fit: fit the package's projection again and stop.
        results: folder of the table.
    """
    for name in methods:
        lookup(KNOWN, name, "method")
    for number in labels:
        if not 1 <= number <= demonstrations:
            raise ValueError(f"labels must be from 1 to the {demonstrations} demonstrations, got {number}")
    for who in HABITS:
        if not (folder / who / "meta" / "info.json").exists():
            record_videos(folder / who, who, demonstrations, task=task)
    if fit:
        recordings, _ = read_sources([folder / who for who in HABITS], get_task(task))
        print(embed_recordings(recordings, get_task(task), folder / "fit", network=NETWORK))
        shutil.copy(folder / "fit" / "cameras" / f"{CAMERA}.safetensors", SCOOPING.with_stem(task))
        return
    evaluation = EvalConfig(episodes=episodes, threads=1, execution=ExecutionConfig(replan_interval=8))
    done, write = open_table(results / f"{task}.csv", COLUMNS, KEYS)
    for seed, others, number, method in product(seeds, unlabelled, labels, methods):
        if tuple(map(str, (number, others, method, seed, episodes))) not in done:
            options = {"steps": steps, "controller_steps": controller_steps, "evaluation": evaluation}
            row = run_cell(folder, task, others, number, method, seed, **options)
            write(row)
            print(*row, flush=True)


if __name__ == "__main__":
    tyro.cli(main)
