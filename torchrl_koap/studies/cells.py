# This source code is licensed under the MIT license found in the LICENSE file.
"""A cell of a study on disk: its request, written before it begins, and its result, written last.

``cell.json`` holds whole configurations, so a worker needs only the folder, be it a process of this machine, of a
cluster, or started by hand. ``result.json`` is written atomically, so a process may be killed at any moment.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.offline import KIND
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import changed_options, from_json, to_json
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.tasks.columns import thousandths
from torchrl_koap.training import train

ASKED, FOUND = "cell.json", "result.json"
# distance of the evaluation seeds of consecutive training seeds. With the same noise for all training seeds, 180
# rollouts would carry hardly more information than 60
NOISE_STEP = 1000
Result = tuple[dict[str, Any], dict[tuple[int, int], float]]
"""A row, and outcomes as :data:`~torchrl_koap.studies.paired_comparison.Outcome`."""
_MAY_CHANGE = ("dataset", "out", "planner.source", "run.plugins")  # folders may move, plugins may be added


@dataclass(frozen=True)
class Cell:
    """One cell of a study.

    Args:
        task (str): name of the task.
        method (str): name in :data:`~torchrl_koap.training.methods.METHODS`.
        labels (float): share of the units that keep their labels.
        demonstrations (float): share of the demonstrations that is used at all.
        seed (int): seed of label choice, initialisation and batches.
    """

    task: str
    method: str
    labels: float
    demonstrations: float
    seed: int

    @property
    def folder(self) -> str:
        """Its run directory, relative to the study's: ``cells/avoiding/koap-0.02-1-seed0``."""
        return f"cells/{self.task}/{self.method}-{self.labels:.15g}-{self.demonstrations:.15g}-seed{self.seed}"


def prepare_cell(folder: Path, config: TrainConfig, evaluation: EvalConfig | None) -> None:
    """Writes the request of a cell, or of a shared planner, before it begins; refuses a different earlier request."""
    try:
        earlier = read_asked(folder)[0]
    except RunDirectoryError:  # missing or damaged; ``config.json`` also names the options of a run
        earlier = config
    if changed := [name for name in changed_options(earlier, config) if name not in _MAY_CHANGE]:
        raise RunDirectoryError(f"{folder} was started with another {', '.join(changed)}")
    content = {"train": to_json(config), "evaluation": None if evaluation is None else to_json(evaluation)}
    RunDirectory(folder).write_json(ASKED, content)


def read_asked(folder: Path) -> tuple[TrainConfig, EvalConfig | None]:
    """Reads the request of a cell; a RunDirectoryError names a ``cell.json`` that is missing or damaged."""
    content, path = RunDirectory(folder).read_json(ASKED), folder / ASKED
    if content.keys() != {"train", "evaluation"}:
        raise RunDirectoryError(f"{path} is damaged: wanted the entries train and evaluation")
    evaluation = content["evaluation"]
    config = from_json(TrainConfig, content["train"], path)
    return config, None if evaluation is None else from_json(EvalConfig, evaluation, path)


def run_cell(folder: str | Path) -> None:
    """Trains and evaluates a cell, or trains a shared planner, as :func:`prepare_cell` wrote; resumes earlier work."""
    folder = Path(folder)
    config, evaluation = read_asked(folder)
    config = replace(config, run=replace(config.run, resume=(folder / "config.json").exists()))
    run, began = RunDirectory(folder), time.perf_counter()
    if evaluation is None:
        results = train(config, planner_only=True).results
        run.write_json(FOUND, {"row": {"train_seconds": time.perf_counter() - began}, "outcomes": [], **results})
        return
    if not (folder / "summary.json").exists():
        train(config)
    summary, began = run.read_json("summary.json"), time.perf_counter()
    result = evaluate(folder, replace(evaluation, dataset=config.dataset))  # the data may have moved
    seconds = {"train_seconds": sum(summary["train_seconds"].values()), "eval_seconds": time.perf_counter() - began}
    run.write_json(FOUND, {"row": _found_in(summary, result) | seconds, "outcomes": _outcomes_of(result)})


def read_result(folder: str | Path) -> Result | None:
    """Reads the result of a cell, None if it is not finished; a RunDirectoryError names a damaged ``result.json``.

    The row has columns of :data:`~torchrl_koap.studies.table.CELL_COLUMNS`.
    """
    if not (Path(folder) / FOUND).exists():
        return None
    content = RunDirectory(folder).read_json(FOUND)
    try:
        outcomes = {(context, seed): float(value) for context, seed, value in content["outcomes"]}
        return dict(content["row"]), outcomes
    except (KeyError, TypeError, ValueError) as error:
        raise RunDirectoryError(f"{Path(folder) / FOUND} is damaged: {type(error).__name__}: {error}") from error


def cell_row(root: Path, cell: Cell, *, label_unit: str, reason: str | None = None) -> Result:
    """Reads a cell of a study's folder as a row of ``cells.csv``, and its outcomes, which are empty unless it is done.

    ``reason`` is why it failed, if it did.
    """
    row = asdict(cell) | {"label_unit": label_unit, "run": cell.folder}
    try:
        found = read_result(root / cell.folder)
    except RunDirectoryError as error:
        found, reason = None, reason or str(error)
    if found is None:
        return row | ({"status": "failed", "reason": reason} if reason else {"status": "missing"}), {}
    return row | {"status": "done"} | found[0], found[1]


def _found_in(summary: Mapping[str, Any], result: Mapping[str, Any]) -> dict[str, Any]:
    labels = summary["labels"]
    common = {
        "labelled_units": labels["selected_units"],
        "labelled_transitions": labels["labelled_transitions"],
        "trajectories_touched": labels["trajectories_touched"],
        "controller_updates": summary["controller_updates"],
    }
    if (split := result["action_errors_on"]) is not None:
        row = result["action_errors"][split]["unit"][0]
        unit, factor = thousandths(row["unit"])  # of the first column
        common |= {"action_error": row["controller"] * factor, "action_error_unit": unit}
    if result.get("kind") == KIND:
        names = ("relative_plan_error", "relative_action_error", "action_errors_on")
        return common | {"kind": KIND} | {name: result[name] for name in names}
    entropy, success = result.get("mode_entropy"), result["rates"]["success"]
    common |= {name: result.get(name) for name in ("episodes", "collisions", "mean_steps")}
    common |= {f"success_{name}": success[name] for name in ("rate", "low", "high")}
    common["successes"] = round(success["rate"] * result["episodes"])
    return common | {"mode_entropy": result.get("pooled_mode_entropy") if entropy is None else entropy}


def _outcomes_of(result: Mapping[str, Any]) -> list[list[float]]:
    """Returns the success of every episode with context and seed; without an environment errors by trajectory.

    The seed of an episode without a context serves as its context.
    """
    if result.get("kind") == KIND:
        split = result["action_errors_on"]
        rows = result["action_errors"][split]["trajectory"] if split else ()
        found = [(row["episode"], row["relative_action_error"]) for row in rows]
        return [[episode, 0, error] for episode, error in found if error is not None]  # None: no action varies
    return [
        [row["seed"] if row.get("context") is None else row["context"], row["seed"], row["outcome"] == "success"]
        for row in result["episode"]
    ]
