# This source code is licensed under the MIT license found in the LICENSE file.
"""Adds one row to the table of planners that were tried: success in closed loop over several noise seeds.

    python benchmarks/planner_ablations.py RUN --seeds 100 1100 2100 --candidates 4 --note "wider"
    python benchmarks/planner_ablations.py RUN --controller oracle        # the simulator's own inverse map

Every seed is one rollout in each of the fixed contexts (60 episodes on Avoiding, which has none). Sixty rollouts tell
88 from 96 % by luck alone, so the table holds the sum.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
from collections import defaultdict
from pathlib import Path

from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.config import CONTROLLERS
from torchrl_koap.evaluation.policy_files import BLEND_DECAY
from torchrl_koap.evaluation.statistics import conditional_entropy, mode_entropy, wilson_interval
from torchrl_koap.files import replacing_file
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import get_task

TABLE = Path(__file__).parent / "results" / "planner_ablations.csv"
SIZES = ("denoiser_width", "denoiser_depth", "condition_octaves", "dropout", "planner_weight_decay")
UNITS = {"trajectory": "trajectories", "window": "windows", "transition": "transitions"}
# in rows that were written before the column
OLDER = {"controller": "learned", "stacked": "", "disturbed": "0.0", "command_lead": "0.0", "action_gain": "1.0"}
OLDER |= {"preset": "default"}
OTHERS = ("first_steps_weight", "precision", "recovery_sigma", "planner_learning_rate")
PLANS = ("frame", "plan_steps", "observed_frames", "gripper_recovery")


def planner_of(config: dict) -> str:
    """The denoiser and its options in words."""
    given = {name: config[name] for name in (*SIZES, *OTHERS, *PLANS) if config.get(name) is not None}
    if config["denoiser"] == "unet":
        given = {"channels": tuple(config["channels"])} | given
    words = {name: ",".join(map(str, value)) if isinstance(value, list) else value for name, value in given.items()}
    return " ".join([config["denoiser"], *(f"{name}={value}" for name, value in words.items())])


def disturbance_notes(dataset: str) -> dict:
    """How the operators of a data set were disturbed, as `koap demos` notes; nothing where they were not."""
    for folder in (Path(dataset), Path(dataset) / "ted"):
        if (folder / "about.json").is_file():
            notes = json.loads((folder / "about.json").read_text(encoding="utf-8")).get("notes") or {}
            return notes.get("disturbance", {})
    return {}


def disturbed_share(dataset: str) -> float:
    """Share of the demonstrations of a data set that were recorded with a disturbed operator."""
    return float(disturbance_notes(dataset).get("share", 0.0))


def labels_of(config: dict) -> str:
    """The label budget in words."""
    if config.get("label_episodes") is not None:
        return f"trajectories {config['label_episodes']}"
    if config.get("label_count") is not None:
        return f"{config['label_count']} {config['label_unit']}"
    if config["label_fraction"] == 1:
        return "all"
    return f"{config['label_fraction']:g} of {UNITS[config['label_unit']]}"


def planner_source(config: dict) -> tuple[str | None, dict]:
    """The run that trained the planner of a run, None for the run itself, and its ``config.json``."""
    source = None
    while config.get("planner_from"):  # a planner that was taken over is described by the run that trained it
        source = config["planner_from"]
        config = RunDirectory(source).read_json("config.json")
    return source, config


def row_of(path: Path, results: list[dict], choices: dict, note: str, controller: str = "learned") -> dict:
    """One row of the table from a run directory and its evaluations."""
    run = RunDirectory(path)
    config, summary = run.read_json("config.json"), run.read_json("summary.json")
    task = get_task(config["task"])
    source, trained = planner_source(config)
    rows = [row for result in results for row in result["episode"]]
    won = [row for row in rows if row["outcome"] == "success"]
    low, high = wilson_interval(len(won), len(rows))
    if rows[0].get("context") is None:
        entropy = mode_entropy([row["mode"] for row in won if row["mode"] >= 0], task.num_modes)
    else:  # several rollouts in each context
        groups = defaultdict(list)
        for row in rows:
            groups[row["context"]] += [row["mode"]] * (row["outcome"] == "success" and row["mode"] >= 0)
        unsolved = "zero" if task.modes.entropy == "contexts" else "skip"
        entropy = conditional_entropy(list(groups.values()), task.num_modes, unsolved=unsolved)
    trained_by = RunDirectory(source).read_json("summary.json") if source else summary
    seconds = trained_by["train_seconds"]
    return {
        "task": config["task"],
        "demonstrations": summary["labels"].get("trajectories", summary["trajectories_used"]),
        "labels": labels_of(config),
        "method": config["method"],
        "denoiser": planner_of(trained),
        "updates": trained["steps"],
        "batch": trained["batch_size"],
        "train_seconds": round(seconds["controller" if config["method"] == "dp" else "planner"]),
        "training_seed": config["seed"],
        **choices,
        "successes": len(won),
        "n": len(rows),
        "success": round(len(won) / len(rows), 3),
        "low": round(low, 3),
        "high": round(high, 3),
        "by_seed": " ".join(str(sum(row["outcome"] == "success" for row in result["episode"])) for result in results),
        "entropy": None if entropy is None else round(entropy, 3),
        "collisions": sum(row["outcome"] == "collision" for row in rows),
        "mean_steps": round(statistics.fmean(row["steps"] for row in rows), 1),
        "mean_steps_won": round(statistics.fmean(row["steps"] for row in won), 1) if won else None,
        "note": note,
        "command": config["command"],
        "controller": controller,
        "stacked": stacked_of(results),
        "disturbed": disturbed_share(trained["dataset"]),
        "command_lead": results[0].get("command_lead", 0.0),  # evaluations of before have none
        "action_gain": results[0].get("action_gain", 1.0),
        "preset": config["controller"]["preset"] if "controller" in config else OLDER["preset"],
    }


def stacked_of(results: list[dict]) -> str:
    """Rollouts with one, two and three boxes in the zone of Stacking, empty for other tasks."""
    names = [f"stacked_{count}_rate" for count in (1, 2, 3)]
    if any(name not in results[0] for name in names):
        return ""
    return " ".join(str(sum(round(result[name] * result["episodes"]) for result in results)) for name in names)


def append(row: dict, table: Path) -> None:
    """Adds a row; columns that the rows before did not have yet are filled with what those were."""
    table.parent.mkdir(parents=True, exist_ok=True)
    earlier = []
    if table.exists():
        with table.open(newline="") as file:
            reader = csv.DictReader(file)
            earlier, known = list(reader), reader.fieldnames or []
        if list(known) != list(row):  # written before a column was there
            strange = [name for name in known if name not in row]
            if strange:
                raise ValueError(f"{table} has columns that no row gets any more: {', '.join(strange)}")
    with replacing_file(table) as aside, aside.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(row), restval="", lineterminator="\n")
        writer.writeheader()
        added = {name: value for name, value in OLDER.items() if name in row}
        writer.writerows([added | line for line in earlier])
        writer.writerow(row)


def main() -> None:
    """Evaluates and adds the row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[100, 1100, 2100])
    parser.add_argument("--episodes", type=int, default=60)
    parser.add_argument("--controller", choices=CONTROLLERS, default="learned")
    parser.add_argument("--candidates", type=int, default=1)
    parser.add_argument("--replan-interval", type=int, default=4)
    parser.add_argument("--blend-decay", type=float, default=BLEND_DECAY)
    parser.add_argument("--command-lead", type=float, help="default: the task's; 0: any distance")
    parser.add_argument("--action-gain", type=float, help="default: the task's")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--note", default="")
    parser.add_argument("--table", type=Path, default=TABLE)
    options = parser.parse_args()
    choices = {
        "candidates": options.candidates,
        "choice": "quarter" if options.candidates > 1 else "",
        "replan_interval": options.replan_interval,
        "blend_decay": options.blend_decay,
    }
    results = []
    for seed in options.seeds:
        settings = {name: value for name, value in choices.items() if name != "choice"}
        settings["controller"] = options.controller
        settings |= {"command_lead": options.command_lead, "action_gain": options.action_gain}
        config = EvalConfig(episodes=options.episodes, seed=seed, threads=options.threads, **settings)
        results.append(evaluate(options.run, config))
    row = row_of(options.run, results, choices, options.note, options.controller)
    append(row, options.table)
    keys = ("candidates", "choice", "successes", "n", "success", "low", "high", "by_seed", "entropy", "mean_steps")
    print(options.run.name, {key: row[key] for key in keys})


if __name__ == "__main__":
    main()
