# This source code is licensed under the MIT license found in the LICENSE file.
"""The comparisons of the paper as presets of label-efficiency curves, its figures drawn beside ours."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_koap.lookup import lookup
from torchrl_koap.studies.label_efficiency import CurveConfig, run_curve
from torchrl_koap.studies.paper_results import paper_points
from torchrl_koap.studies.report import write_curve_report
from torchrl_koap.studies.table import read_cells, write_cells
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.training.plugins import Plugins, load_plugins
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

PAPER_TASKS = tuple(name for name, task in TASKS.items() if task.in_paper)


@dataclass(frozen=True)
class Preset:
    """One comparison.

    Args:
        title (str): heading of the report.
        methods (str): names, with commas between.
        tasks (tuple of str): tasks it is made on.
        levels (int, optional): label levels, from the fewest labels on. Default: all of the task.
        observations (str): shares of the trajectories that are used at all.

    Examples:
        >>> from torchrl_koap.studies.paper_tables import Preset
        >>> Preset("Two methods", "koap,dd", tasks=("avoiding",)).levels
        (1, 2, 3, 4, 5)
    """

    title: str
    methods: str
    tasks: tuple[str, ...] = PAPER_TASKS
    levels: tuple[int, ...] = (1, 2, 3, 4, 5)
    observations: str = "1"


# the paper's methods, tasks and levels; its figures are in torchrl_koap.studies.paper_results
PRESETS = {
    "table 1": Preset("Methods against label levels", "koap,linear,dd,vae,lapo,dp"),
    "table 2": Preset(
        "Variants of the method",
        "koap,koap_sgd,koap_labelled_only,pretrain,nonlinear,relabel",
        ("avoiding", "po_sorting"),
    ),
    "study observations": Preset(
        "Success against the amount of unlabelled data", "koap,dd,linear", ("avoiding",), (2,), "0.1,0.25,0.5,1"
    ),
}


@dataclass
class BenchConfig:
    """Reproduce a comparison of the paper: a curve per task, and one report over all.

    Attributes:
        out: folder; each task has a curve of its own in it, and the same command goes on where it was interrupted.
        table: 1 (methods) or 2 (variants).
        study: "observations" (unlabelled data at fixed labels) instead of a table.
        tasks: names with commas between, instead of the preset's.
        methods: names with commas between, instead of the preset's.
        units: what label levels are shares of: "window" as in the paper, or "trajectory".
        demonstrations: number of scripted demonstrations (default: that of the task).
        seeds: number of seeds of label choice and training.
        episodes: rollouts per cell.
        steps: planner updates (default: that of the task).
        controller_steps: updates of every controller.
        released_settings: the unequal settings of the first public code.
        epochs: with released settings, epochs instead of the first code's.
        workers: cells at a time (default: one per core).
        launcher: "local" or "ray".
        address: of a Ray cluster.
        plugins: modules that register tasks, methods or pictures.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.studies.paper_tables import BenchConfig, run_bench
        >>> config = BenchConfig(out=Path("bench"), table=1, tasks="avoiding", seeds=1)
        >>> run_bench(config)  # doctest: +SKIP
    """

    out: Path
    table: int | None = None
    study: str | None = None
    tasks: str | None = None
    methods: str | None = None
    units: str | None = None
    demonstrations: int | None = None
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


def run_bench(config: BenchConfig) -> dict[str, Any]:
    """Does what is missing of a comparison; writes ``cells.csv`` and the report over all tasks.

    Args:
        config (BenchConfig): which comparison, and where to write it.

    Returns:
        dict: how many cells are done, failed and missing, and where the report is.

    Raises:
        ValueError: if not exactly one of table and study is given, or there is no such one, or for an unknown task.
        RunDirectoryError: if the folder holds another comparison, or one of its curves cannot go on
            (:func:`~torchrl_koap.studies.label_efficiency.run_curve`).
    """
    if (config.table is None) == (config.study is None):
        raise ValueError("exactly one of --table and --study is needed")
    load_plugins(config.plugins)
    name = f"study {config.study}" if config.table is None else f"table {config.table}"
    preset = lookup(PRESETS, name, "comparison")
    tasks = preset.tasks if config.tasks is None else [task.strip() for task in config.tasks.split(",")]
    facts = [get_task(task) for task in tasks]
    # the study needs labels of whole trajectories: windows of a share touch nearly all of them
    units = config.units or ("window" if config.study is None else "trajectory")
    root = RunDirectory(config.out)
    if (root.path / "bench.json").exists() and root.read_entry("bench.json", "comparison") != name:
        raise RunDirectoryError(f"{root.path} holds another comparison than {name!r}; choose another --out")
    root.write_json("bench.json", {"comparison": name})
    rows, paper = [], []
    for task in facts:
        fractions = [task.label_levels[level - 1] for level in preset.levels]
        run_curve(
            CurveConfig(
                out=config.out / task.name,
                task=task.name,
                demonstrations=config.demonstrations,
                methods=config.methods or preset.methods,
                fractions=",".join(f"{fraction:g}" for fraction in fractions),
                units=units,
                observations=preset.observations,
                seeds=config.seeds,
                episodes=config.episodes,
                steps=config.steps,
                controller_steps=config.controller_steps,
                released_settings=config.released_settings,
                epochs=config.epochs,
                workers=config.workers,
                launcher=config.launcher,
                address=config.address,
                plugins=config.plugins,
            )
        )
        rows += [row | {"run": f"{task.name}/{row['run']}"} for row in read_cells(config.out / task.name / "cells.csv")]
        paper += paper_points(task.name, task.label_levels)
        # after every task: a long benchmark can be looked at while it runs
        write_cells(config.out / "cells.csv", rows)
        report = write_curve_report(
            config.out, rows, title=preset.title, paper=paper if units == "window" and config.table else None
        )
    counts = {status: sum(row["status"] == status for row in rows) for status in ("done", "failed", "missing")}
    return counts | {"report": str(report)}
