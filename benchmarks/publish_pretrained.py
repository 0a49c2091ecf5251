# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes ``pretrained/NAME`` from a run: compact weights, options, and a model card with its evaluation.

    python benchmarks/publish_pretrained.py RUN NAME --seeds 100 1100 2100

The compact policy is evaluated in 60 episodes per seed.
"""

from __future__ import annotations

import json
import statistics
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor
from tyro.conf import Positional

from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.statistics import conditional_entropy, mode_entropy, wilson_interval
from torchrl_koap.runs.run_directory import RunDirectory, copy_run
from torchrl_koap.runs.weights import ROW_SCALE, load_tensors, save_tensors
from torchrl_koap.tasks import get_task

WEIGHTS = ("planner.safetensors", "controller.safetensors")
PLACES = ("out", "dataset")
LEAST = 4096  # entries; smaller matrices are not compacted
ROOT = Path(__file__).resolve().parents[1] / "pretrained"
CARD = """# {name}

A policy for the task `{task}` in this library's own simulation, trained on **scripted** demonstrations.

| | |
|---|---|
| success | {successes} of {n} episodes, {success:.1%} (95 % Wilson interval {low:.1%} to {high:.1%}) |
| by noise seed | {by_seed} of 60 with {seeds} |
| entropy of the modes | {entropy} |
| mean steps | {mean_steps} ({mean_steps_won} where successful) |
| evaluated | these compact weights, {contexts} |
| data | {demonstrations} scripted demonstrations (`{recorded}`) |
| labels | {labels}, method `{method}` |
| planner | {denoiser}, {updates} updates of {batch} windows, training seed {training_seed} |
| training time | {train_seconds} s of {processor} |
| weights | matrices of the planner as bytes with a scale per row, the rest float32 |

Roll it out, films and report included:

    koap eval pretrained:{name} --episodes 60 --seed 100 --out DIR

Made by

    {command}
    python benchmarks/publish_pretrained.py RUN {name}
"""


def compact(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Converts matrices to ``int8`` with a scale per row, which :func:`~torchrl_koap.runs.weights.expand` reads.

    Args:
        tensors (mapping): a state dict; entries with two or more axes and at least 4,096 floats are matrices.
    """
    small = {}
    for name, tensor in tensors.items():
        if tensor.ndim < 2 or tensor.numel() < LEAST or not tensor.is_floating_point():
            small[name] = tensor
            continue
        scale = tensor.flatten(1).abs().amax(1).clamp_min(1e-12).div(127).reshape(-1, *[1] * (tensor.ndim - 1))
        small[name] = (tensor / scale).round().to(torch.int8)
        small[name + ROW_SCALE] = scale.float()
    return small


def publish(run: str | Path, folder: str | Path, card: str) -> Path:
    """Writes a trained policy in the repository's format: compact weights, options, a model card.

    Only the last part is kept of the paths of the run, its data and a planner that it took over. Paths on another
    machine carry no information.

    Args:
        run (str or Path): run directory of ``koap train``.
        folder (str or Path): folder to write, new or of an earlier policy; its name becomes that of the policy.
        card (str): text of the ``README.md``: data, updates, success, command.

    Returns:
        Path: the folder.
    """
    folder = Path(folder)
    (folder / "config.json").unlink(missing_ok=True)  # replaces an earlier policy of that name
    folder = copy_run(run, folder)
    (folder / "demonstrations.safetensors").unlink(missing_ok=True)  # 40 MB for Sorting; recorded again by the card
    published = RunDirectory(folder)
    config = published.read_json("config.json")
    places = {name: Path(config[name]).name for name in PLACES if config.get(name) is not None}
    source = config["planner"]["source"]
    planner = config["planner"] | {"source": None if source is None else Path(source).name}
    published.write_json("config.json", config | places | {"planner": planner})
    for name in WEIGHTS:
        if (folder / name).exists():
            tensors, about = load_tensors(folder / name)
            # controllers are not rounded: a closed-form decoder fits only the exact frequencies of its features
            exact = name == "controller.safetensors" and (folder / WEIGHTS[0]).exists()
            save_tensors(folder / name, tensors if exact else compact(tensors), about)
    (folder / "README.md").write_text(card)
    return folder


def numbers_of(run: Path, results: list[dict[str, Any]]) -> dict[str, Any]:
    """Returns the entries of the model card of a run and its evaluations."""
    config, summary = (RunDirectory(run).read_json(name) for name in ("config.json", "summary.json"))
    source, trained = run, config
    while trained["planner"]["source"]:  # the run that trained the planner describes it
        source = trained["planner"]["source"]
        trained = RunDirectory(source).read_json("config.json")
    task = get_task(config["task"])
    rows = [row for result in results for row in result["episode"]]
    won = [row for row in rows if row["outcome"] == "success"]
    low, high = wilson_interval(len(won), len(rows))
    shown = [row for row in won if row["mode"] >= 0]
    if rows[0].get("context") is None:
        entropy = mode_entropy([row["mode"] for row in shown], task.modes.number)
    else:  # several rollouts in each context
        groups: dict[int, list[int]] = {row["context"]: [] for row in rows}
        for row in shown:
            groups[row["context"]].append(row["mode"])
        unsolved = "zero" if task.modes.entropy == "contexts" else "skip"
        entropy = conditional_entropy(list(groups.values()), task.modes.number, unsolved=unsolved)
    labels = summary["labels"]
    commands = [config["command"]] if source == run else [trained["command"], config["command"]]
    disturbance = disturbance_of(Path(trained["dataset"]))
    recorded = f"koap demos --task {task.name} --episodes {labels['total_trajectories']} --seed 0"
    seconds = RunDirectory(source).read_json("summary.json")["train_seconds"]
    return {
        "task": task.name,
        "method": config["method"],
        "successes": len(won),
        "n": len(rows),
        "success": len(won) / len(rows),
        "low": low,
        "high": high,
        "by_seed": " ".join(str(sum(row["outcome"] == "success" for row in result["episode"])) for result in results),
        "entropy": None if entropy is None else round(entropy, 3),
        "mean_steps": round(statistics.fmean(row["steps"] for row in rows), 1),
        "mean_steps_won": round(statistics.fmean(row["steps"] for row in won), 1) if won else None,
        "demonstrations": labels["total_trajectories"],
        "recorded": recorded + (f" --disturbance {disturbance:g}" if disturbance else ""),
        "labels": f"{labels['selected_units']} of {labels['total_units']} ({labels['unit']})",
        "denoiser": trained["planner"]["network"],
        "updates": trained["planner"]["steps"],
        "batch": trained["planner"]["batch_size"],
        "training_seed": config["run"]["seed"],
        "processor": "a GPU" if trained["run"]["device"].startswith("cuda") else "one shared CPU core",
        "train_seconds": round(seconds["controller" if config["method"] == "dp" else "planner"]),
        "command": "\n    ".join(commands),
    }


def disturbance_of(dataset: Path) -> float:
    """Returns the share of demonstrations in a data set that were recorded with a disturbed operator."""
    for about in (dataset / "about.json", dataset / "ted" / "about.json"):
        if about.is_file():
            notes = json.loads(about.read_text(encoding="utf-8")).get("notes") or {}
            return float(notes.get("disturbance", 0.0))
    return 0.0


def main(run: Positional[Path], name: Positional[str], *, seeds: tuple[int, ...] = (100, 1100, 2100)) -> None:
    """Publishes a run, evaluates the published policy, and writes its model card.

    Args:
        run: the run directory.
        name: folder below ``pretrained``.
        seeds: noise seeds, 60 episodes each.
    """
    folder = publish(run, ROOT / name, "")
    metrics = (folder / "metrics.csv").read_text().splitlines(keepends=True)
    kept = [metrics[0], *metrics[1::5]]  # every fifth row is enough for the report's curves
    (folder / "metrics.csv").write_text("".join(kept))
    with tempfile.TemporaryDirectory() as out:
        results = [
            evaluate(folder, EvalConfig(out=Path(out) / "run", episodes=60, seed=seed, threads=1)) for seed in seeds
        ]
    contexts = "the 60 fixed contexts with every seed" if "contexts" in results[0] else "all from the same start"
    card = numbers_of(run, results) | {"name": name, "seeds": list(seeds)}
    (folder / "README.md").write_text(CARD.format(**card, contexts=contexts))
    size = sum(file.stat().st_size for file in folder.iterdir())
    print(f"{folder}: {card['successes']} of {card['n']}, {size / 1e6:.2f} MB")


if __name__ == "__main__":
    tyro.cli(main)
