# This source code is licensed under the MIT license found in the LICENSE file.
"""Label-efficiency curves: methods x label budgets x seeds on one shared planner, resumable at any moment."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from torchrl_koap.runs.plugins import Plugins, load_plugins
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.studies.cell_options import (
    CellOptions,
    check_cell_options,
    evaluation_options,
    planner_options,
    training_options,
)
from torchrl_koap.studies.cells import Cell, do_cell, do_planner, is_trained, planner_folder, train_config
from torchrl_koap.studies.curve_data import check_budgets, demonstrations_of, first_look
from torchrl_koap.studies.curve_folder import GROWS, check_folder, read_options, with_earlier_plugins, write_options
from torchrl_koap.studies.curve_table import CurveTable
from torchrl_koap.studies.launchers import Job, check_launcher, launch
from torchrl_koap.studies.paper_results import paper_points
from torchrl_koap.studies.report import write_curve_report
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.training.datasets import find_task_of, load_demonstrations
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.trained import build_networks

ALL = "koap,koap_labelled_only,linear,dd,vae,lapo,dp,relabel,nonlinear,pretrain"


@dataclass
class CurveConfig(CellOptions):
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
        units: "trajectory", "window" (the unit of the first public code) or "transition".
        observations: shares of the trajectories that are used at all, with commas between.
        seeds: number of seeds of label choice and training.
        episodes: rollouts per cell; all cells with the same seed meet the same contexts and noise.
        steps: planner updates (default: that of the task).
        controller_steps: updates of every controller.
        workers: cells at a time (default: one per core; a cluster given by its address decides for itself).
        launcher: "local" or "ray".
        address: of a Ray cluster (default: one on this machine).
        planner_from: finished run, or pretrained:NAME, whose planner all cells share instead of training one; it must
            have been trained on the same data, which nothing here can check.
        planner_observations: share of the trajectories that planners are trained on (default: that of the cell).
        first_seed_only: of the fractions, those that are measured with the first seed alone.
        data_share: share of the trajectories that are used at all, drawn before any label is; `fractions` stay shares
            of the whole (`observations` are shares of what is used).
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
    workers: int | None = None
    launcher: str = "local"
    address: str | None = None
    planner_from: Path | None = None
    planner_observations: float | None = None
    first_seed_only: str = ""
    data_share: float = 1.0
    plugins: Plugins = ()

    def __post_init__(self):
        self.out = Path(self.out)  # so that a string will do in Python
        self.planner_from = None if self.planner_from is None else find_run(self.planner_from)


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

    Examples:
        >>> from torchrl_koap import CurveConfig, run_curve
        >>> config = CurveConfig(out="curve", methods="koap,linear", fractions="0.01,0.1", seeds=2)
        >>> run_curve(config)["done"]  # doctest: +SKIP
        8
        >>> run_curve(CurveConfig(out="curve", methods="kaop"))  # refused before anything is done
        Traceback (most recent call last):
        ...
        ValueError: unknown method 'kaop'; did you mean 'koap'?
    """
    options, task, cells, root = check_curve(config)
    to_record = options.dataset == "scripted" and not (root.path / "demonstrations" / "ted").exists()
    check_budgets(cells, options, first_look(root, options, task))
    with root.locked("koap curve", "lock"):
        check_folder(root, options)  # another one may have finished here in the meantime
        dataset = demonstrations_of(root, options, task)
        if to_record:
            check_budgets(cells, options, load_demonstrations(dataset, task))
        write_options(root, options)
        known = _all_cells(root, cells, options)
        table = CurveTable(root.path, known, task=options.task, label_unit=options.units)
        _work(root, options, cells, dataset, table)
        rows = table.write()
        paper = paper_points(task.name) if options.units == "window" else None
        report = write_curve_report(root.path, rows, title=f"Label efficiency on {task.name}", paper=paper)
    counts = {status: sum(row["status"] == status for row in rows) for status in ("done", "failed", "missing")}
    return counts | {"report": str(report)}


def check_curve(config: CurveConfig) -> tuple[CurveConfig, Task, list[Cell], RunDirectory]:
    """Refuses what cannot be done of a curve without looking at any data; nothing is written.

    Args:
        config (CurveConfig): what to compare on what.

    Returns:
        tuple: the options with what earlier calls in the folder add, the task, all cells, the folder.

    Raises:
        ValueError, RunDirectoryError, PluginError: as :func:`run_curve`.
    """
    options = with_earlier_plugins(config)
    load_plugins(options.plugins)
    cells = _cells(options)
    task = (
        get_task(options.task or "avoiding")
        if options.dataset == "scripted"
        else find_task_of(options.dataset, options.task)
    )
    options = replace(options, task=task.name)
    for name in ("seeds", "demonstrations", "episodes", "steps", "controller_steps", "workers"):
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    methods = list(dict.fromkeys(cell.method for cell in cells))
    check_cell_options(options, [get_method(name) for name in methods])
    check_launcher(options.launcher, address=options.address)
    root = RunDirectory(options.out.absolute())
    check_folder(root, options)
    for name in methods:
        _check_method(name, options, task)
    return options, task, cells, root


def _check_method(name: str, options: CurveConfig, task: Task) -> None:
    """Refuses a method whose networks cannot be built for the task, or for the planner that is to be shared."""
    method = get_method(name)
    settings: dict[str, Any] = {
        "out": str(options.out),
        "task": task.name,
        "method": name,
        "steps": options.steps,
        "planner_from": str(options.planner_from) if method.plans and options.planner_from is not None else None,
    }
    config = resolve(train_config(**settings | training_options(options, name)), task)
    try:
        build_networks(task, config)
    except ValueError as error:
        read = f"the columns {config.controller.columns!r} of " if method.plans else ""
        raise ValueError(f"method {name!r} cannot read {read}task {task.name!r}: {error}") from error


def _cells(options: CurveConfig) -> list[Cell]:
    """All cells in the order asked for; repeated names count once."""
    methods = _split("methods", options.methods, str)
    for name in methods:
        get_method(name)
    fractions = _split("fractions", options.fractions, float)
    observations = _split("observations", options.observations, float)
    for name, values in {"fractions": fractions, "observations": observations}.items():
        for value in values:
            if not 0 < value <= 1:
                raise ValueError(f"{name} must be in (0, 1], got {value:g}")
    if not 0 < options.data_share <= 1:
        raise ValueError(f"data_share must be in (0, 1], got {options.data_share:g}")
    if max(fractions) > options.data_share:
        raise ValueError(
            f"fractions must be at most data_share, the share of the data that is used ({options.data_share:g}),"
            f" got {max(fractions):g}"
        )
    if options.planner_observations is not None and not 0 < options.planner_observations <= 1:
        raise ValueError(f"planner_observations must be in (0, 1], got {options.planner_observations:g}")
    once = _split("first_seed_only", options.first_seed_only, float) if options.first_seed_only else []
    return [
        Cell(method, fraction, share, seed)
        for seed in range(options.seeds)
        for share in observations
        for fraction in fractions
        if not (seed and fraction in once)
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


def _work(root: RunDirectory, options: CurveConfig, cells: Sequence[Cell], dataset: str, table: CurveTable) -> None:
    """Does the cells that are not done."""
    common = {
        "task": options.task,
        "dataset": dataset,
        "steps": options.steps,
        "controller_steps": options.controller_steps,
        "plugins": options.plugins,
    }
    cell_settings = common | {"label_unit": options.units}
    todo = [cell for cell in cells if not table.is_done(cell)]
    todo.sort(key=lambda cell: cell.planner is not None)  # those without a planner need not wait for one
    jobs, names, planners = [], {}, {}
    for cell in todo:
        folder = root.path / cell.folder
        planner = _planner_of(cell, root, options)
        arguments = {
            "folder": str(folder),
            "cell": asdict(cell),
            "planner": None if planner is None else str(planner),
            "settings": cell_settings | training_options(options, cell.method),
            "label_fraction": cell.fraction / options.data_share,
            "evaluation": {"episodes": options.episodes, "threads": 1} | evaluation_options(options, cell.method),
        }
        needs: tuple[str, ...] = ()
        if planner is not None and options.planner_from is None and not is_trained(planner):
            planners[planner.name] = (planner, _planner_share(cell, options), _planner_seed(cell, options))
            needs = (planner.name,)
        jobs.append(Job(cell.folder, do_cell, arguments, folder / "log.txt", needs))
        names[cell.folder] = cell
    first = [
        Job(
            name,
            do_planner,
            {
                "folder": str(folder),
                "observations": share,
                "settings": common | planner_options(options) | ({"seed": seed} if seed else {}),
            },
            folder / "log.txt",
        )
        for name, (folder, share, seed) in planners.items()
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


def _planner_share(cell: Cell, options: CurveConfig) -> float:
    """Share of the trajectories that the planner of a cell is trained on."""
    return cell.observations if options.planner_observations is None else options.planner_observations


def _planner_seed(cell: Cell, options: CurveConfig) -> int:
    """Seed of the planner of a cell."""
    return cell.seed % options.planner_seeds


def _planner_of(cell: Cell, root: RunDirectory, options: CurveConfig) -> Path | None:
    """The run whose planner a cell takes over, None for a method without one."""
    if not get_method(cell.method).plans:
        return None
    if options.planner_from is not None:
        return Path(options.planner_from).absolute()
    return root.path / planner_folder(_planner_share(cell, options), _planner_seed(cell, options))


def _all_cells(root: RunDirectory, cells: Sequence[Cell], options: CurveConfig) -> list[Cell]:
    """The cells asked for now, and those asked for earlier."""
    earlier, asked = read_options(root, type(options)), set(cells)
    grown = replace(options, **{name: earlier[name] for name in GROWS})
    return [*cells, *(cell for cell in _cells(grown) if cell not in asked and (root.path / cell.folder).exists())]
