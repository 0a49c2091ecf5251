# This source code is licensed under the MIT license found in the LICENSE file.
"""The work of a label-efficiency curve: shared planners and cells, each in a folder that says when it is finished.

A cell is one method, one budget of labels, one seed. Its folder is an ordinary run directory; ``cell.json``, written
last and in one go, marks it as done, so a process may be killed at any moment.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from torchrl_koap.evaluation import EvalConfig, evaluate
from torchrl_koap.evaluation.offline import KIND
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import from_json
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.tasks.units import thousandths
from torchrl_koap.training import get_method, train

DONE = "cell.json"
# evaluation seeds of a training seed lie so far from the next one's: rollouts that differ in nothing but the training
# would count as 180 where they are hardly more than 60
NOISE_STEP = 1000
# options of a curve, in the sections of TrainConfig
_NAMES = {
    "denoiser": "planner.network",
    "denoiser_width": "planner.width",
    "batch_size": "planner.batch_size",
    "planner_learning_rate": "planner.learning_rate",
    "planner_from": "planner.source",
    "steps": "planner.steps",
    "controller_steps": "controller.steps",
    "controller_state": "controller.columns",
    "label_fraction": "labels.fraction",
    "label_unit": "labels.unit",
    "observation_fraction": "labels.trajectories",
    "precision": "run.precision",
    "seed": "run.seed",
    "resume": "run.resume",
    "plugins": "run.plugins",
}
_ERRORS = ("relative_plan_error", "relative_action_error")


@dataclass(frozen=True)
class Cell:
    """One cell of a curve.

    Args:
        method (str): name in :data:`~torchrl_koap.training.methods.METHODS`.
        fraction (float): share of the units that keep their labels.
        observations (float): share of the trajectories that are used at all.
        seed (int): of label choice, initialisation and batches.

    Examples:
        >>> from torchrl_koap.studies.cells import Cell
        >>> Cell("koap", fraction=0.02, observations=1.0, seed=0).folder
        'cells/koap-0.02-1-seed0'
    """

    method: str
    fraction: float
    observations: float
    seed: int

    @property
    def folder(self) -> str:
        """Its run directory, relative to the curve's."""
        return f"cells/{self.method}-{self.fraction:.15g}-{self.observations:.15g}-seed{self.seed}"

    @property
    def planner(self) -> str | None:
        """The folder of the planner that it shares, None for a method without one."""
        return planner_folder(self.observations) if get_method(self.method).plans else None


def planner_folder(observations: float, seed: int = 0) -> str:
    """Folder of the planner that all cells with this share of the trajectories, and this seed of it, have in common.

    Args:
        observations (float): share of the trajectories that it is trained on.
        seed (int): its seed. Defaults to ``0``.
    """
    return f"planner-{observations:.15g}" + (f"-seed{seed}" if seed else "")


def is_trained(folder: Path) -> bool:
    """Whether a planner was finished."""
    return _is_readable(RunDirectory(folder), DONE) and (folder / "planner.safetensors").is_file()


def is_done(folder: Path) -> bool:
    """Whether a cell was finished and all its results can be read; if not, it is to be done (again)."""
    try:
        _results(RunDirectory(folder))
    except RunDirectoryError:
        return False
    return True


def _is_readable(run: RunDirectory, name: str) -> bool:
    try:
        run.read_json(name)
    except RunDirectoryError:
        return False
    return True


def train_config(**options: Any) -> TrainConfig:
    """Sorts the options of a cell into the sections of a configuration.

    Args:
        **options: of :class:`~torchrl_koap.studies.cell_options.CellOptions` and of a cell, None where left open.

    Examples:
        >>> from torchrl_koap.studies.cells import train_config
        >>> train_config(out="cell", steps=20, denoiser="mlp").planner.network
        'mlp'
    """
    content: dict[str, Any] = {}
    for name, value in options.items():
        section, dot, own = _NAMES.get(name, name).rpartition(".")
        if value is not None:
            (content.setdefault(section, {}) if dot else content)[own] = value
    return from_json(TrainConfig, content, "options of a cell")


def do_planner(*, folder: str, observations: float, settings: dict[str, Any]) -> None:
    """Trains a planner on states alone: all actions are hidden before anything looks at the data.

    Keyword Args:
        folder (str): where to.
        observations (float): share of the trajectories to use.
        settings (dict): options of :class:`~torchrl_koap.training.TrainConfig`.
    """
    began = time.perf_counter()
    resume = (Path(folder) / "config.json").exists()
    config = train_config(out=folder, observation_fraction=observations, resume=resume, **settings)
    losses = train(config, planner_only=True).results["planner"]
    RunDirectory(folder).write_json(DONE, {"train_seconds": time.perf_counter() - began} | losses)


def do_cell(
    *,
    folder: str,
    cell: dict[str, Any],
    planner: str | None,
    settings: dict[str, Any],
    evaluation: dict[str, Any],
    label_fraction: float | None = None,
) -> None:
    """Trains and evaluates a cell, from where it was left.

    Keyword Args:
        folder (str): its run directory.
        cell (dict): fields of :class:`Cell`.
        planner (str, optional): folder of the planner to share.
        settings (dict): options of :class:`~torchrl_koap.training.TrainConfig`.
        evaluation (dict): options of :class:`~torchrl_koap.evaluation.EvalConfig`, without the seed: all cells with the
            same training seed meet the same noise, those of the next one other noise, in the same contexts.
        label_fraction (float, optional): share of the labels of the data at hand, where the cell's is a share of more.
    """
    path, this = Path(folder), Cell(**cell)
    began = time.perf_counter()
    if not _is_readable(RunDirectory(path), "summary.json"):
        train(
            train_config(
                out=folder,
                method=this.method,
                label_fraction=this.fraction if label_fraction is None else label_fraction,
                observation_fraction=this.observations,
                seed=this.seed,
                planner_from=planner,
                resume=(path / "config.json").exists(),
                **settings,
            )
        )
    trained = time.perf_counter()
    result = evaluate(path, EvalConfig(seed=EvalConfig.seed + NOISE_STEP * this.seed, **evaluation))
    run = RunDirectory(path)
    run.write_json(
        DONE,
        asdict(this)
        | {
            "labels": run.read_entry("summary.json", "labels"),
            "train_seconds": trained - began,
            "eval_seconds": time.perf_counter() - trained,
            **_counts(result),
        },
    )


def cell_row(root: Path, cell: Cell, *, task: str, label_unit: str, reason: str | None = None) -> dict[str, Any]:
    """A cell as a row of ``cells.csv`` (:data:`~torchrl_koap.studies.table.CELL_COLUMNS`).

    Args:
        root (Path): folder of the curve.
        cell (Cell): the cell.

    Keyword Args:
        task (str): name of the task.
        label_unit (str): what the fraction is a share of.
        reason (str, optional): why it failed.
    """
    row: dict[str, Any] = {"task": task, **asdict(cell), "label_unit": label_unit, "run": cell.folder}
    run = RunDirectory(root / cell.folder)
    try:
        return row | {"status": "done"} | _results(run)
    except RunDirectoryError as error:
        if reason is None and (run.path / DONE).exists():  # it was done once
            reason = str(error)
    return row | ({"status": "missing"} if reason is None else {"status": "failed", "reason": reason})


def _results(run: RunDirectory) -> dict[str, Any]:
    """What a finished cell found.

    Raises:
        RunDirectoryError: if a file is not there, damaged or lacks something, or somebody evaluated the cell otherwise.
    """
    done, summary, result = (run.read_json(name) for name in (DONE, "summary.json", "eval.json"))
    try:
        columns = _columns(done, summary, result)
        counts = _counts(result)
        done.setdefault("episodes", counts["episodes"])  # a cell of before says nothing of them
        same = all(done[name] == value for name, value in counts.items())
    except (KeyError, TypeError, AttributeError) as error:
        raise RunDirectoryError(f"{run.path}: its results are damaged ({type(error).__name__}: {error})") from error
    if not same:
        raise RunDirectoryError(f"{run.path / 'eval.json'} is another evaluation than the curve's")
    return columns


def _counts(result: dict[str, Any]) -> dict[str, Any]:
    """What says whether an evaluation is the one that a cell was finished with."""
    if result.get("kind") == KIND:
        return {"episodes": None, "successes": None, **{name: result[name] for name in _ERRORS}}
    return {"episodes": result["episodes"], "successes": round(result["success_rate"] * result["episodes"])}


def _columns(done: dict[str, Any], summary: dict[str, Any], result: dict[str, Any]) -> dict[str, Any]:
    labels = done["labels"]
    errors: dict[str, Any] = next((value for name, value in summary.items() if name.startswith("action_error")), {})
    common = {
        "labelled_units": labels["selected_units"],
        "labelled_transitions": labels["labelled_transitions"],
        "trajectories_touched": labels["trajectories_touched"],
        "action_error": errors.get("controller"),
        "controller_updates": summary["controller_updates"],
        "train_seconds": done["train_seconds"],
        "eval_seconds": done["eval_seconds"],
    }
    if result.get("kind") == KIND:
        return common | {"kind": KIND, "action_error": _own_error(result)} | {name: result[name] for name in _ERRORS}
    entropy = result["mode_entropy"]
    return common | {
        "episodes": result["episodes"],
        "successes": done["successes"],
        "success_rate": result["success_rate"],
        "success_low": result["success_low"],
        "success_high": result["success_high"],
        "mode_entropy": result.get("pooled_mode_entropy") if entropy is None else entropy,
        "collisions": result["collisions"],
        "mean_steps": result["mean_steps"],
    }


def _own_error(result: dict[str, Any]) -> float | None:
    """Error of the actions in the unit of the first column, as it is shown; None if nothing was measured."""
    split = result["action_errors_on"]
    if split is None:
        return None
    row = result["action_errors"][split]["unit"][0]
    return row["controller"] * thousandths(row["unit"])[1]
