# This source code is licensed under the MIT license found in the LICENSE file.
"""Label-efficiency curves: methods x label budgets x seeds on one shared planner, resumable at any moment."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, flatten_trajectories, save_ted, subsample_trajectories
from torchrl_koap.studies.cells import Cell, do_cell, do_planner, is_trained, planner_folder
from torchrl_koap.studies.curve_table import CurveTable
from torchrl_koap.studies.launchers import Job, check_launcher, launch
from torchrl_koap.studies.paper_results import paper_points
from torchrl_koap.studies.report import write_curve_report
from torchrl_koap.tasks import HISTORY, WINDOW, Task
from torchrl_koap.training.datasets import find_task_of, load_demonstrations
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.plugins import Plugins, load_plugins
from torchrl_koap.training.progress import count_up_to, progress_bar
from torchrl_koap.training.released_settings import get_released
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.training.saved_options import check_types

ALL = "koap,koap_labelled_only,linear,dd,vae,lapo,dp,relabel,nonlinear,pretrain"


@dataclass
class CurveConfig:
    """Measure success against the number of labels: methods x label fractions x seeds.

    Attributes:
        out: folder of the curve; the same command goes on where it was interrupted, and may add methods, fractions or
            seeds.
        task: name of the task (default: that of the data set, if it says so; else "avoiding").
        dataset: "scripted", or a folder: written by `koap demos` or save_demonstrations, of D3IL raw pickles, or a
            LeRobot data set.
        demonstrations: number of scripted demonstrations (default: that of the task).
        methods: names in torchrl_koap.training.methods.METHODS, with commas between.
        fractions: shares of the units that keep their labels, with commas between.
        units: "trajectory", "window" (the paper's levels) or "transition".
        observations: shares of the trajectories that are used at all, with commas between.
        seeds: number of seeds of label choice and training.
        episodes: rollouts per cell; all cells meet the same ones.
        steps: planner updates (default: that of the task); a number below controller_steps shortens that too.
        controller_steps: updates of every controller.
        released_settings: the unequal settings of the first public code instead of equal ones (koap, pretrain, dd, dp).
        epochs: with released settings, epochs instead of the first code's.
        workers: cells at a time (default: one per core; a cluster given by its address decides for itself).
        launcher: "local" or "ray".
        address: of a Ray cluster (default: one on this machine).
        plugins: modules that register tasks, methods or pictures; every cell imports them, and every later call.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.studies.label_efficiency import CurveConfig, run_curve
        >>> config = CurveConfig(out=Path("curve"), methods="koap,dd", fractions="0.01,0.1", seeds=2)
        >>> run_curve(config)  # doctest: +SKIP
    """

    out: Path
    task: str | None = None
    dataset: str = "scripted"
    demonstrations: int | None = None
    methods: str = ALL
    fractions: str = "0.01,0.02,0.05,0.1,0.25"
    units: str = "trajectory"
    observations: str = "1"
    seeds: int = 3
    episodes: int = 60
    steps: int | None = None
    controller_steps: int = 1000
    released_settings: bool = False
    epochs: int | None = None
    workers: int | None = None
    launcher: str = "local"
    address: str | None = None
    plugins: Plugins = ()

    def __post_init__(self):
        self.out = Path(self.out)  # so that a string will do in Python


# what all cells of a folder must have in common; the rest may grow
_FIXED = (
    "task",
    "dataset",
    "demonstrations",
    "units",
    "episodes",
    "steps",
    "controller_steps",
    "released_settings",
    "epochs",
)
_GROWS = ("methods", "fractions", "observations", "seeds")


def run_curve(config: CurveConfig) -> dict[str, Any]:
    """Does what is missing of a curve and writes its report; ``koap curve`` calls this.

    Args:
        config (CurveConfig): what to compare on what, and where to write it.

    Returns:
        dict: how many cells are done, failed and missing, and where the report is.

    Raises:
        ValueError: for unknown methods, fractions out of range or that select nothing.
        RunDirectoryError: if the folder holds something else, a curve with other settings, or one that is being worked
            on.
        PluginError: if a plugin cannot be imported.
    """
    options = _with_earlier_plugins(config)
    load_plugins(options.plugins)
    cells = _cells(options)
    task = find_task_of(options.dataset, options.task)
    options = replace(options, task=task.name)
    for name in ("seeds", "demonstrations", "episodes", "steps", "controller_steps", "epochs", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    if options.epochs is not None and not options.released_settings:
        raise ValueError("epochs are counted with --released-settings only; otherwise there are --controller-steps")
    check_launcher(options.launcher, address=options.address)
    root = RunDirectory(options.out.absolute())
    _check_folder(root, options)
    to_record = options.dataset == "scripted" and not (root.path / "demonstrations" / "ted").exists()
    _check_budgets(cells, options, _first_look(root, options, task))
    with root.locked("koap curve", "lock"):
        _check_folder(root, options)  # another one may have finished here in the meantime
        dataset = _demonstrations(root, options, task)
        if to_record:
            _check_budgets(cells, options, load_demonstrations(dataset, task))
        _write_options(root, options)
        known = _all_cells(root, cells, options)
        table = CurveTable(root.path, known, task=options.task, label_unit=options.units)
        _work(root, options, cells, dataset, table)
        rows = table.write()
        paper = paper_points(task.name, task.label_levels) if options.units == "window" else None
        report = write_curve_report(root.path, rows, title=f"Label efficiency on {task.name}", paper=paper)
    counts = {status: sum(row["status"] == status for row in rows) for status in ("done", "failed", "missing")}
    return counts | {"report": str(report)}


def _cells(options: CurveConfig) -> list[Cell]:
    """All cells in the order asked for; repeated names count once."""
    methods = _split("methods", options.methods, str)
    for name in methods:
        get_released(name) if options.released_settings else get_method(name)
    fractions = _split("fractions", options.fractions, float)
    observations = _split("observations", options.observations, float)
    for name, values in {"fractions": fractions, "observations": observations}.items():
        for value in values:
            if not 0 < value <= 1:
                raise ValueError(f"{name} must be in (0, 1], got {value:g}")
    return [
        Cell(method, fraction, share, seed)
        for seed in range(options.seeds)
        for share in observations
        for fraction in fractions
        for method in methods
    ]


def _split(name: str, text: str, kind: type) -> list[Any]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise ValueError(f"{name} must name at least one, got {text!r}")
    try:
        return list(dict.fromkeys(kind(part) for part in parts))
    except ValueError:
        raise ValueError(f"{name} must be numbers with commas between, got {text!r}") from None


def _check_folder(root: RunDirectory, options: CurveConfig) -> None:
    if (root.path / "curve.json").exists():
        earlier, now = _earlier(root), _plain(options)
        # an option that is younger than the folder was at its default
        earlier = {name: earlier.get(name, getattr(CurveConfig, name)) for name in _FIXED}
        changed = [f"{name} ({value})" for name, value in earlier.items() if now[name] != value]
        if changed:
            raise RunDirectoryError(
                f"{root.path} holds a curve with another {', '.join(changed)}; choose another --out"
            )
        return
    if root.path.exists() and not root.path.is_dir():
        raise RunDirectoryError(f"{root.path} is a file; choose another --out")
    # what a curve leaves that was killed before it came to write its options
    own = ("lock", "demonstrations", ".curve.json.")
    if root.path.exists() and not all(path.name.startswith(own) for path in root.path.iterdir()):
        raise RunDirectoryError(f"{root.path} is not empty and no folder of `koap curve`; choose another --out")


def _plain(options: CurveConfig) -> dict[str, Any]:
    return asdict(options) | {"out": str(options.out), "dataset": _dataset(options)}


def _write_options(root: RunDirectory, options: CurveConfig) -> None:
    """Keeps what was asked for, earlier methods, fractions and seeds included."""
    content = _plain(options)
    if (root.path / "curve.json").exists():
        earlier = _earlier(root)
        for name in ("methods", "fractions", "observations"):
            content[name] = ",".join(dict.fromkeys([*str(earlier[name]).split(","), *content[name].split(",")]))
        content["seeds"] = max(earlier["seeds"], content["seeds"])
    root.write_json("curve.json", content)


def _with_earlier_plugins(options: CurveConfig) -> CurveConfig:
    """The options with the plugins of earlier calls, without which methods of theirs would be unknown."""
    root = RunDirectory(options.out)
    earlier = _earlier(root).get("plugins") or () if (root.path / "curve.json").exists() else ()
    return replace(options, plugins=tuple(dict.fromkeys([*earlier, *options.plugins])))


def _dataset(options: CurveConfig) -> str:
    """The data set by its whole path: a cell may run in another working directory."""
    return options.dataset if options.dataset == "scripted" else str(Path(options.dataset).absolute())


def _first_look(root: RunDirectory, options: CurveConfig, task: Task) -> TensorDictBase | None:
    """What can be known of the demonstrations without recording any: if nothing else, how many there will be."""
    if options.dataset == "scripted" and task.env is None:
        raise ValueError(f"task {task.name!r} has no environment to record demonstrations in: name a --dataset")
    if options.dataset != "scripted":
        return load_demonstrations(_dataset(options), task)
    if (root.path / "demonstrations" / "ted").exists():
        return load_demonstrations(str(root.path / "demonstrations"), task)
    if options.units != "trajectory":
        LabelBudget(1, unit=options.units)  # knows the units
        return None
    number = options.demonstrations or task.defaults.demonstrations
    return flatten_trajectories([torch.zeros(2, 1)] * number, [torch.zeros(1, 1)] * number)


def _demonstrations(root: RunDirectory, options: CurveConfig, task: Task) -> str:
    """The data set as a folder: scripted demonstrations are recorded once for all cells."""
    if options.dataset != "scripted":
        return _dataset(options)
    folder = root.path / "demonstrations"
    if not (folder / "ted").exists():
        from torchrl_koap.envs.experts.demonstrations import record_demonstrations

        episodes = options.demonstrations or task.defaults.demonstrations
        with progress_bar(episodes, "demonstrations", unit="episode") as bar:
            data, _ = record_demonstrations(task.name, episodes, 0, progress=count_up_to(bar))
        save_ted(data, folder / "ted", task=task.source)
    return str(folder)


def _check_budgets(cells: Sequence[Cell], options: CurveConfig, data: TensorDictBase | None) -> None:
    """Refuses before any work what would fail in a cell: budgets that select nothing, shares below the labelled."""
    if data is None:
        return
    # windows of another seed lie in another number of trajectories
    for fraction, share, seed in dict.fromkeys((cell.fraction, cell.observations, cell.seed) for cell in cells):
        budget = LabelBudget(fraction, unit=options.units, seed=seed, window=WINDOW, history=HISTORY)
        subsample_trajectories(budget.apply(data)[0], share)


def _work(root: RunDirectory, options: CurveConfig, cells: Sequence[Cell], dataset: str, table: CurveTable) -> None:
    """Does the cells that are not done."""
    common = {
        "task": options.task,
        "dataset": dataset,
        "steps": options.steps,
        "controller_steps": options.controller_steps,
        "plugins": options.plugins,
    }
    cell_settings = common | {
        "label_unit": options.units,
        "released_settings": options.released_settings,
        "epochs": options.epochs,
    }
    evaluation = {"episodes": options.episodes, "threads": 1}
    todo = [cell for cell in cells if not table.is_done(cell)]
    todo.sort(key=lambda cell: cell.planner is not None)  # those without a planner need not wait for one
    jobs, names = [], {}
    for cell in todo:
        folder = root.path / cell.folder
        planner = None if cell.planner is None else root.path / cell.planner
        arguments = {
            "folder": str(folder),
            "cell": asdict(cell),
            "planner": None if planner is None else str(planner),
            "settings": cell_settings,
            "evaluation": evaluation,
        }
        needs = () if planner is None or is_trained(planner) else (cell.planner,)
        jobs.append(Job(cell.folder, do_cell, arguments, folder / "log.txt", needs))
        names[cell.folder] = cell
    planners = dict.fromkeys(need for job in jobs for need in job.needs)
    shares = {planner_folder(cell.observations): cell.observations for cell in todo}
    first = [
        Job(
            name,
            do_planner,
            {"folder": str(root.path / name), "observations": shares[name], "settings": common},
            root.path / name / "log.txt",
        )
        for name in planners
    ]
    # a job of a cluster may not use all cores of its machine
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = options.workers or cores
    with progress_bar(len(first) + len(jobs), "cells", unit="cell", smoothing=0.1) as bar:
        ended = launch(
            [*first, *jobs],
            launcher=options.launcher,
            workers=workers,
            address=options.address,
            preload=[do_cell.__module__],
        )
        with closing(ended):
            for job, reason in ended:
                bar.update()
                bar.set_postfix_str(job.name.removeprefix("cells/") + (" FAILED" if reason else ""))
                if job.name in names:
                    table.ended(names[job.name], reason)


def _all_cells(root: RunDirectory, cells: Sequence[Cell], options: CurveConfig) -> list[Cell]:
    """The cells asked for now, and those asked for earlier."""
    earlier, asked = _earlier(root), set(cells)
    grown = replace(options, **{name: earlier[name] for name in _GROWS})
    return [*cells, *(cell for cell in _cells(grown) if cell not in asked and (root.path / cell.folder).exists())]


def _earlier(root: RunDirectory) -> dict[str, Any]:
    """What ``curve.json`` holds, its entries of the types that they were written with."""
    earlier = root.read_json("curve.json")
    check_types(root.path / "curve.json", earlier, get_type_hints(CurveConfig))
    return earlier
