# This source code is licensed under the MIT license found in the LICENSE file.
"""The comparisons of the paper as presets of label-efficiency curves, its figures beside ours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_koap.lookup import lookup
from torchrl_koap.runs.plugins import Plugins, load_plugins
from torchrl_koap.runs.pretrained import PREFIX, pretrained_folders
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies.cell_options import OPTION_NAMES, PLANNER, CellOptions
from torchrl_koap.studies.label_efficiency import CurveConfig, check_curve, run_curve
from torchrl_koap.studies.paper_layout import write_paper_layout
from torchrl_koap.studies.paper_results import paper_points, paper_share
from torchrl_koap.studies.report import write_curve_report
from torchrl_koap.studies.table import read_cells, write_cells
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.training.methods import METHODS

PAPER_TASKS = ("avoiding", "aligning", "sorting", "po_sorting", "stacking_unobserved_joints")
# a planner of these is as good as any that was tried (docs/results/planners.md)
WIDE_PLANNER = {
    "denoiser": "mlp",
    "denoiser_width": 512,
    "precision": "auto",
    "batch_size": 256,
    "planner_learning_rate": 1e-3,
}
POLICY_STEPS = 8000  # at most: dp trains a network in every cell, planners are shared
SMALL_PLANNER = WIDE_PLANNER | {"denoiser_width": 256, "batch_size": 128}
# what --quick asks for where nothing else is: a table that can be read, not one to be cited
QUICK = {"demonstrations": 48, "seeds": 1, "episodes": 10, "steps": 2000, "controller_steps": 200}
QUICK_LEVEL = 1


@dataclass(frozen=True)
class Preset:
    """One comparison.

    Args:
        title (str): heading of the report.
        methods (str): names, with commas between; those that are not registered are left out.
        tasks (tuple of str): tasks it is made on.
        levels (tuple of int, optional): label levels, from the fewest labels on. Default: all of the task.
        first_seed_only (tuple of int): of the levels, those that are measured with the first seed alone.
        fractions (str): shares of labels instead of levels.
        observations (str): shares of the trajectories that are used at all.
        planner_observations (float, optional): share of the trajectories that the planner knows. Default: the same.

    Examples:
        >>> from torchrl_koap.studies.paper_tables import Preset
        >>> Preset("Two methods", "koap,dd", tasks=("avoiding",)).levels
        (1, 2, 3, 4, 5)
    """

    title: str
    methods: str
    tasks: tuple[str, ...] = PAPER_TASKS
    levels: tuple[int, ...] = (1, 2, 3, 4, 5)
    first_seed_only: tuple[int, ...] = ()
    fractions: str = ""
    observations: str = "1"
    planner_observations: float | None = None


_OBSERVATIONS = "0.1,0.25,0.5,1"
# the paper's methods, tasks and levels; its figures are in torchrl_koap.studies.paper_results
PRESETS = {
    "table 1": Preset(
        "Methods against label levels",
        "koap,koap_paper,koap_untrained,linear_steps,pca,dd,vae,lapo,dp",
        first_seed_only=(3, 4),
    ),
    "table 2": Preset(
        "Variants of the method",
        "koap,koap_paper,koap_sgd,koap_labelled_only,koap_untrained,nonlinear,pretrain,relabel",
        ("avoiding", "stacking_unobserved_joints"),
        first_seed_only=(3, 4),
    ),
    "study observations": Preset(
        "Success against the controller's unlabelled data, the planner fixed",
        "koap,koap_paper,koap_untrained,pca,linear_steps,dd",
        ("avoiding",),
        fractions="0.01",
        observations=_OBSERVATIONS,
        planner_observations=1.0,
    ),
    "study observations_and_planner": Preset(
        "Success against the unlabelled data of controller and planner",
        "koap,koap_paper,koap_untrained,pca,linear_steps,dd",
        ("avoiding",),
        fractions="0.01",
        observations=_OBSERVATIONS,
    ),
}


@dataclass
class BenchConfig(CellOptions):
    """Reproduce a comparison of the paper: a curve per task, and one report over all.

    Attributes:
        out: folder; each task has a curve of its own in it, and the same command goes on where it was interrupted.
        table: 1 (methods) or 2 (variants).
        study: "observations" (unlabelled data of the controller at 1 % of the labels, the planner fixed) or
            "observations_and_planner" (the planner grows too) instead of a table.
        quick: a small comparison, to be read and not to be cited: few demonstrations, one seed, the level of fewest
            labels, ten rollouts, and the planners that the repository holds (pretrained:TASK); a small one is trained
            where it holds none, or where an option says how planners are made.
        tasks: names with commas between, instead of the preset's.
        methods: names with commas between, instead of the preset's (and the task's own, if it has another).
        levels: label levels (1: fewest labels) with commas between, instead of the preset's.
        units: what label levels are shares of: "window" (the first public code's unit) or "trajectory".
        dataset: "scripted", a folder for a single task, or task=FOLDER with commas between.
        planners: task=RUN with commas between: finished runs, or pretrained:NAME, whose planners are shared instead of
            training them; the data set a run was trained on is used where --dataset names none for the task.
        data_share: share of the demonstrations that are used at all, labels staying shares of the whole: "all", or
            "paper" for its half or quarter, by one reading of its text.
        demonstrations: number of scripted demonstrations (default: that of the task).
        seeds: number of seeds of label choice and training; levels 3 and 4 of a table have the first alone.
        all_levels_alike: levels 3 and 4 have all seeds too.
        episodes: rollouts per cell.
        steps: updates of planner and dp (default: that of the task, for dp at most 8,000).
        controller_steps: updates of every controller.
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
    quick: bool = False
    tasks: str | None = None
    methods: str | None = None
    levels: str | None = None
    units: str | None = None
    dataset: str = "scripted"
    planners: str = ""
    data_share: str = "all"
    demonstrations: int | None = None
    seeds: int | None = None
    all_levels_alike: bool = False
    episodes: int | None = None
    steps: int | None = None
    controller_steps: int | None = None
    workers: int | None = None
    launcher: str = "local"
    address: str | None = None
    plugins: Plugins = ()

    def __post_init__(self):
        self.out = Path(self.out)  # so that a string will do in Python


def run_bench(config: BenchConfig) -> dict[str, Any]:
    """Does what is missing of a comparison; writes ``cells.csv`` and the report over all tasks of the folder.

    Args:
        config (BenchConfig): which comparison, and where to write it.

    Returns:
        dict: how many cells are done, failed and missing, and where the report is.

    Raises:
        ValueError: if not exactly one of table and study is given, for unknown tasks, methods and levels, and for what
            :func:`~torchrl_koap.studies.label_efficiency.check_curve` refuses; before any work on any task.
        RunDirectoryError: if the folder holds another comparison, or one of its curves cannot go on
            (:func:`~torchrl_koap.studies.label_efficiency.run_curve`).

    Examples:
        >>> from torchrl_koap.studies import BenchConfig, run_bench
        >>> run_bench(BenchConfig(out="bench", table=1, tasks="avoiding", seeds=1))["done"]  # doctest: +SKIP
        36
        >>> run_bench(BenchConfig(out="bench", table=1, tasks="avoidign"))  # refused before anything is done
        Traceback (most recent call last):
        ...
        ValueError: unknown task 'avoidign'; did you mean 'avoiding'?
    """
    if (config.table is None) == (config.study is None):
        raise ValueError("exactly one of --table and --study is needed")
    load_plugins(config.plugins)
    name = f"study {config.study}" if config.table is None else f"table {config.table}"
    preset = lookup(PRESETS, name, "comparison")
    root = RunDirectory(config.out)
    if (root.path / "bench.json").exists() and root.read_entry("bench.json", "comparison") != name:
        raise RunDirectoryError(f"{root.path} holds another comparison than {name!r}; choose another --out")
    for other in ("config.json", "curve.json"):
        if (root.path / other).exists():
            raise RunDirectoryError(f"{root.path} is the folder of a run or curve ({other}); choose another --out")
    curves = _curves(config, preset)
    for curve in curves:
        check_curve(curve)
    root.write_json("bench.json", {"comparison": name})
    # tasks that an earlier call did in the folder stay in its tables
    names = list(dict.fromkeys([*preset.tasks, *(curve.task for curve in curves)]))
    for curve in curves:
        run_curve(curve)
        known = {name: read_cells(file) for name in names if (file := config.out / name / "cells.csv").exists()}
        rows = [row | {"run": f"{name}/{row['run']}"} for name, cells in known.items() for row in cells]
        beside = [name for name, cells in known.items() if {row["label_unit"] for row in cells} == {"window"}]
        paper = [point for name in beside for point in paper_points(name)] if config.table is not None else []
        # after every task: a long benchmark can be looked at while it runs
        write_cells(config.out / "cells.csv", rows)
        layout = write_paper_layout(config.out, rows) if config.table is not None else None
        report = write_curve_report(config.out, rows, title=preset.title, paper=paper or None, layout=layout)
    counts = {status: sum(row["status"] == status for row in rows) for status in ("done", "failed", "missing")}
    return counts | {"report": str(report)}


def _curves(config: BenchConfig, preset: Preset) -> list[CurveConfig]:
    """The curve of every task."""
    names = preset.tasks if config.tasks is None else [task.strip() for task in config.tasks.split(",")]
    tasks = [get_task(name) for name in names]
    datasets = _by_task("dataset", "" if config.dataset == "scripted" else config.dataset, tasks)
    planners = _shared_planners(config, tasks)
    lookup(("all", "paper"), config.data_share, "share of the data")
    # studies need labels of whole trajectories: windows of a share touch nearly all of them
    units = config.units or ("window" if config.study is None else "trajectory")
    quick = dict(QUICK) if config.quick else {}
    if config.study is not None:
        quick.pop("demonstrations", None)  # 1 % of fewer trajectories is none
    standard = {"seeds": 3, "episodes": 60, "controller_steps": 1000, "demonstrations": None, "steps": None}
    values: dict[str, Any] = standard | quick
    values |= {name: getattr(config, name) for name in values if getattr(config, name) is not None}
    own = {name: getattr(config, name) for name in OPTION_NAMES}
    if config.denoiser is None:
        wide = SMALL_PLANNER if config.quick else WIDE_PLANNER
        own |= {name: value for name, value in wide.items() if own[name] is None}
    common = [name for name in preset.methods.split(",") if name in METHODS]
    curves = []
    for task in tasks:
        once = ""
        if preset.fractions and config.levels is None:
            fractions = preset.fractions
        else:
            levels = _levels(config, preset, task)
            fractions = _shares(task, levels)
            if not config.all_levels_alike:
                once = _shares(task, [level for level in levels if level in preset.first_seed_only])
        planner = planners.get(task.name)
        if config.policy_steps is None:
            own["policy_steps"] = values["steps"] or min(POLICY_STEPS, task.defaults.planner["steps"])
        share = paper_share(task.name) if config.data_share == "paper" else None
        usual = [] if config.table is None else [task.defaults.method]  # what `koap train` takes
        methods = config.methods or ",".join(dict.fromkeys([*common, *usual]))
        curves.append(
            CurveConfig(
                out=config.out / task.name,
                task=task.name,
                dataset=datasets.get(task.name) or _dataset_of(planner) or "scripted",
                methods=methods,
                fractions=fractions,
                first_seed_only=once,
                data_share=share or 1.0,
                units=units,
                observations=preset.observations,
                planner_observations=preset.planner_observations,
                planner_from=None if planner is None else Path(planner),
                workers=config.workers,
                launcher=config.launcher,
                address=config.address,
                plugins=config.plugins,
                **values,
                **own,
            )
        )
    return curves


def _shared_planners(config: BenchConfig, tasks: Sequence[Task]) -> dict[str, str]:
    """Runs whose planners are shared, by task: those asked for; for a quick comparison also those of the repository."""
    named = _by_task("planners", config.planners, tasks)
    made = [*PLANNER, "steps"]  # whoever says how planners are made wants them made
    if not config.quick or config.planner_seeds != 1 or any(getattr(config, name) for name in made):
        return named
    found = [task.name for task in tasks if task.name in pretrained_folders()]
    return {name: f"{PREFIX}{name}" for name in found} | named


def _levels(config: BenchConfig, preset: Preset, task: Task) -> list[int]:
    """The levels asked for, each of which the task must have."""
    if config.levels is None:
        return [level for level in preset.levels if not config.quick or level == QUICK_LEVEL]
    try:
        levels = [int(part) for part in config.levels.split(",")]
    except ValueError:
        raise ValueError(f"levels must be whole numbers with commas between, got {config.levels!r}") from None
    for level in levels:
        if not 1 <= level <= len(task.label_levels):
            shares = ", ".join(f"{100 * share:g}" for share in task.label_levels)
            has = f"its levels 1 to {len(task.label_levels)} are {shares} %"
            raise ValueError(f"task {task.name!r} has no label level {level}: {has}")
    return list(dict.fromkeys(levels))


def _shares(task: Task, levels: Sequence[int]) -> str:
    return ",".join(f"{task.label_levels[level - 1]:g}" for level in levels)


def _by_task(name: str, text: str, tasks: Sequence[Task]) -> dict[str, str]:
    """Folders by task, of ``task=FOLDER,task=FOLDER``, or of a single folder for a single task."""
    if not text:
        return {}
    if "=" not in text and len(tasks) == 1:
        return {tasks[0].name: text}
    found = {}
    for part in text.split(","):
        task, equals, folder = part.strip().partition("=")
        if not equals or not folder:
            raise ValueError(f"{name} must be task=FOLDER with commas between, got {part.strip()!r}")
        lookup([facts.name for facts in tasks], task, f"task of {name}:")
        found[task] = folder
    return found


def _dataset_of(planner: str | None) -> str | None:
    """The data set that a planner to share was trained on; a published one does not say where it was."""
    if planner is None or planner.startswith(PREFIX):
        return None
    return RunDirectory(planner).read_entry("config.json", "dataset")
