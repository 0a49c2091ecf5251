# This source code is licensed under the MIT license found in the LICENSE file.
"""Scooping from pixels: what demonstrations of another embodiment are worth.

    python benchmarks/scooping.py --folder runs/scooping
    python benchmarks/scooping.py --folder runs/scooping --methods koap linear dd --labels 2 5 20 --unlabelled both
    python benchmarks/scooping.py --folder runs/moving --task scooping_moving_bowl

Records robot and hand, embeds, trains one planner per set of unlabelled demonstrations and one controller per cell, and
rolls each out. Folder by folder what is there already is not made again, and rows of the table are not run again.

Unlabelled demonstrations are those of the robot, of the hand (then the robot's labelled ones are all there is of it),
both, or none. Labelled ones are the robot's first: they begin at the three start positions in turn.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

from torchrl_koap.envs.scooping.recording import record_videos
from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.execution import STRATEGIES, ExecutionConfig
from torchrl_koap.runs.config import ControllerConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.tasks.scooping import EMBEDDING_DIM, EMBODIMENTS
from torchrl_koap.training import METHODS as KNOWN
from torchrl_koap.training import train
from torchrl_koap.vision.backbones import load_backbone
from torchrl_koap.vision.demonstrations import Source, embed_demonstrations, fit_projection
from torchrl_koap.vision.encoder import FrozenImageEncoder
from torchrl_koap.vision.projection import SCOOPING, load_encoder, projection_of, save_encoder

TABLE = Path(__file__).parent / "results" / "scooping.csv"
TASKS = ("scooping", "scooping_moving_bowl")
UNLABELLED = ("robot", "hand", "both", "none")
FEW_ROBOTS = ("hand", "none")  # the labelled demonstrations are all there are of the robot
METHODS = ["koap", "koap_paper", "dd", "vae", "lapo", "dp", "pca", "linear"]
COLUMNS = (
    "labels", "unlabelled", "method", "execution", "blend_decay", "seed", "n", "successes", "success_low",
    "success_high", "rims", "rim_low", "rim_high", "left", "near", "right", "action_error_mrad", "planner_steps",
    "planner_error",
)  # fmt: skip
KEYS = COLUMNS[:7]  # what tells rows apart


def data_set(folder: Path, unlabelled: str, labels: int, task: str = "scooping") -> Path:
    """The data set of a cell, embedded where it is not there."""
    out = folder / f"data_{_name(unlabelled, labels)}"
    if not (out / "ted").is_dir():
        robot, hand = Source(folder / "robot", embodiment="robot"), Source(folder / "hand", embodiment="hand")
        robots = [Source(folder / "robot", labels) if unlabelled in FEW_ROBOTS else robot]
        sources = robots if unlabelled in ("robot", "none") else [*robots, hand]
        encoder = load_encoder(projection_of(task))
        embed_demonstrations(out, sources, encoder, mixed=len(sources) > 1, task=task)
    return out


def _name(unlabelled: str, labels: int) -> str:
    """A set of unlabelled demonstrations, with the labels that decide what it is."""
    return f"{unlabelled}_{labels}" if unlabelled in FEW_ROBOTS else unlabelled


def planner_of(folder: Path, unlabelled: str, labels: int, seed: int, options) -> Path:
    """A run that holds the planner of a cell, trained where it is not there."""
    run = folder / f"planner_{_name(unlabelled, labels)}_{seed}"
    if not (run / "summary.json").is_file():
        known = {"method": "linear", "steps": options.steps, "seed": seed, "resume": run.exists()}
        train(_config(run, folder, unlabelled, labels, options.task, **known))
    return run


def _config(run: Path, folder: Path, unlabelled: str, labels: int, task: str, **options) -> TrainConfig:
    planner = options.get("planner_from")
    return TrainConfig(
        dataset=str(data_set(folder, unlabelled, labels, task)),
        out=run,
        task=task,
        method=options["method"],
        labels=LabelConfig(episodes=tuple(range(labels))),
        planner=PlannerConfig(steps=options["steps"]) if planner is None else PlannerConfig(source=planner),
        controller=ControllerConfig(steps=options.get("controller_steps")),
        run=RunConfig(seed=options["seed"], resume=options["resume"]),
    )


def run_cell(folder: Path, unlabelled: str, labels: int, method: str, seed: int, options) -> dict:
    """Trains and rolls out one cell."""
    planner = None
    if not method.startswith("dp"):
        planner = planner_of(folder, unlabelled, labels, seed, options)
    run = folder / f"{method}_{unlabelled}_{labels}_{seed}"
    if not (run / "summary.json").is_file():
        settings = {"method": method, "seed": seed, "planner_from": planner, "steps": options.steps}
        settings["resume"] = run.exists()
        settings |= {"controller_steps": options.controller_steps}
        train(_config(run, folder, unlabelled, labels, options.task, **settings))
    # dp has no plans to follow: its chunks of actions are executed as they are
    strategy = None if method.startswith("dp") else options.execution
    execution = ExecutionConfig(strategy, replan_interval=options.replan_interval, blend=options.blend_decay)
    result = evaluate(run, EvalConfig(episodes=options.episodes, threads=1, execution=execution))
    summary = json.loads((run / "summary.json").read_text())
    n = options.episodes
    successes, rims = round(result["success_rate"] * n), round(result["rates"]["spoon over the bowl"]["rate"] * n)
    spans = [f"{value:.4f}" for count in (successes, rims) for value in wilson_interval(count, n)]
    errors = summary.get("action_error_mrad") or {}
    made = json.loads(((planner or run) / "summary.json").read_text())["planner"]
    return dict(
        zip(
            COLUMNS,
            (
                labels, unlabelled, method, options.execution, options.blend_decay, seed, n, successes, *spans[:2],
                rims, *spans[2:],
                *(f"{result['rates'][f'success from {start}']['rate']:.3f}" for start in ("left", "near", "right")),
                f"{errors['controller']:.1f}" if "controller" in errors else "", options.steps,
                f"{made.get('loss_planner', float('nan')):.4f}",
            ),
            strict=True,
        )
    )  # fmt: skip


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Options of the shell; what cannot be run is refused before anything is recorded.

    Args:
        arguments (sequence of str, optional): words. Default: those of the process.

    Raises:
        SystemExit: for an unknown method, or a number out of range; stderr names the option.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--task", choices=TASKS, default=TASKS[0], help="each has a folder and a table of its own")
    parser.add_argument("--demonstrations", type=int, default=100)
    parser.add_argument("--methods", nargs="+", default=METHODS)
    parser.add_argument("--labels", type=int, nargs="+", default=[5, 2, 20])
    parser.add_argument("--unlabelled", nargs="+", choices=UNLABELLED, default=list(UNLABELLED))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--episodes", type=int, default=15)
    parser.add_argument("--steps", type=int, default=2000, help="planner updates")
    parser.add_argument("--controller-steps", type=int, default=200)
    parser.add_argument("--replan-interval", type=int, default=8, help="frames of each plan that are executed")
    parser.add_argument("--execution", choices=STRATEGIES[:2], default="open_loop", help="of plans")
    parser.add_argument("--blend-decay", type=float, default=0.0, help="of plans; 0 leaves them as they are")
    parser.add_argument("--fit-projection", action="store_true", help="make the package's projection anew and stop")
    options = parser.parse_args(arguments)
    for name in options.methods:
        try:
            lookup(KNOWN, name, "method")
        except ValueError as error:
            parser.error(f"--methods: {error}")
    for name, least in (("demonstrations", 1), ("episodes", 1), ("steps", 1), ("controller_steps", 0)):
        if getattr(options, name) < least:
            parser.error(f"--{name.replace('_', '-')} must be at least {least}, got {getattr(options, name)}")
    for labels in options.labels:
        if not 1 <= labels <= options.demonstrations:
            parser.error(f"--labels must be from 1 to the {options.demonstrations} demonstrations, got {labels}")
    if not 0 <= options.blend_decay < 1:
        parser.error(f"--blend-decay must be in [0, 1), got {options.blend_decay}")
    return options


def measured(table: Path) -> set[tuple[str, ...]]:
    """The cells that a table has, each with its plans, seed and number of rollouts."""
    if not table.exists():
        return set()
    with table.open(newline="") as file:
        return {tuple(row[key] for key in KEYS) for row in csv.DictReader(file)}


def append(table: Path, row: Mapping[str, object]) -> None:
    """Adds a row to a table, which begins with the names of the columns."""
    new = not table.exists()
    with table.open("a", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


def main(arguments: Sequence[str] | None = None) -> None:
    options = parse(arguments)
    for who in EMBODIMENTS:
        if not (options.folder / who / "meta" / "info.json").exists():
            record_videos(options.folder / who, who, options.demonstrations, task=options.task)
    if options.fit_projection:
        encoder = FrozenImageEncoder(load_backbone())
        sources = [Source(options.folder / who) for who in EMBODIMENTS]
        encoder.projection = fit_projection(encoder, sources, EMBEDDING_DIM)
        fitted_on = "unlabelled frames of robot and hand, koap demos, seed 0"
        save_encoder(encoder, SCOOPING.with_stem(options.task), stride=8, fitted_on=fitted_on)
        return
    plans, table = (options.execution, options.blend_decay), TABLE.with_stem(options.task)
    for seed, unlabelled, labels, method in product(options.seeds, options.unlabelled, options.labels, options.methods):
        if tuple(map(str, (labels, unlabelled, method, *plans, seed, options.episodes))) not in measured(table):
            row = run_cell(options.folder, unlabelled, labels, method, seed, options)
            append(table, row)
            print(row, flush=True)


if __name__ == "__main__":
    main()
