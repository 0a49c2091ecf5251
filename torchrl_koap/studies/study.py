# This source code is licensed under the MIT license found in the LICENSE file.
"""What a study compares: tasks x methods x labels x demonstrations x seeds, and what all its cells have in common."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.evaluation.config import check_options
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.execution import ExecutionConfig
from torchrl_koap.runs.config import ControllerConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.runs.config_files import changed_options, from_json
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies.cells import NOISE_STEP, Cell
from torchrl_koap.studies.paper import PRESETS
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.training.datasets import find_task_of
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.trained import build_networks

METHODS = (
    *("koap", "koap_untrained", "koap_labelled_only", "linear", "dd", "vae", "lapo", "dp", "relabel", "nonlinear"),
    "pretrain",
)
LABELS = (0.01, 0.02, 0.05, 0.1, 0.25)
DEFAULT_TASK = "avoiding"
FILE = "study.json"
# options of sections that a study has axes for
_OWN = {
    "run.seed": "cells have the seeds 0, 1, ..., as many as --seeds says",
    "run.resume": "it goes on by itself",
    "planner.source": "name runs with --planners",
    "evaluation.out": "a cell is evaluated in its own folder",
}
# what a later call in the folder may add to; all else must be as it was
GROWS = ("tasks", "datasets", "planners", "methods", "labels", "levels", "demonstrations")


@dataclass(frozen=True, kw_only=True)
class Study:
    """Measure success against the number of labels: tasks x methods x shares of labels x seeds.

    Attributes:
        out: folder of the study; the same command goes on where it was interrupted, and may add tasks, methods, shares
            or seeds.
        preset: a comparison of the paper, "table1" (methods), "table2" (variants), "demonstrations" (planner and
            controller know a share of them) or "quick" (a small look at table1): fills in what is not given.
        tasks: names of tasks (default: that of the data set, else "avoiding").
        datasets: folder of the demonstrations of a single task, or TASK=FOLDER for each. Where none is given scripted
            ones are recorded in the folder, once for all cells.
        record: number of scripted demonstrations (default: that of the task).
        methods: names in torchrl_koap.training.methods.METHODS.
        labels: shares of the units that keep their labels.
        levels: label levels of the paper for every task (1: fewest labels) instead of shares.
        label_unit: "trajectory", "window" (the unit of the first public code) or "transition".
        demonstrations: shares of the demonstrations that planner and controller know at all.
        seeds: number of seeds of label choice and training.
        planners: finished run, or pretrained:NAME, whose planner all cells of a task share, or TASK=RUN for each;
            where none is given one is trained. It must know the same data, which nothing here can check.
        planner_seeds: number of planners, trained with seeds 0, 1, ...; a cell of seed s has planner s modulo that.
        planner: network and training of planners, and of methods that have none but sample actions.
        controller: training of every controller.
        execution: how plans become actions.
        evaluation: rollouts of every cell, one thread each; cells with the same seed meet the same contexts and noise.
        run: processor, precision and plugins of every training.

    Examples:
        >>> from torchrl_koap.studies import Study, run_study
        >>> study = Study(out="study", methods=("koap", "dd"), labels=(0.01, 0.1), seeds=2)
        >>> run_study(study)  # doctest: +SKIP
    """

    out: Path
    preset: str | None = None
    tasks: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    record: int | None = None
    methods: tuple[str, ...] = ()
    labels: tuple[float, ...] = ()
    levels: tuple[int, ...] = ()
    label_unit: str | None = None
    demonstrations: tuple[float, ...] = (1.0,)
    seeds: int | None = None
    planners: tuple[str, ...] = ()
    planner_seeds: int = 1
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)
    evaluation: EvalConfig = field(default_factory=EvalConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self):
        object.__setattr__(self, "out", Path(self.out))  # so that a string will do in Python


def complete(study: Study) -> Study:
    """Fills in what the preset, earlier calls in the folder and the library know; paths become absolute.

    Raises:
        ValueError: for an unknown preset or task, or a data set that is no folder.
        RunDirectoryError: if ``study.json`` is damaged.
        PluginError: if a plugin cannot be imported.
    """
    earlier = read_study(study.out)
    plugins = study.run.plugins if earlier is None else (*earlier.run.plugins, *study.run.plugins)
    study = replace(study, run=replace(study.run, plugins=tuple(dict.fromkeys(plugins))))
    load_plugins(study.run.plugins)
    if study.preset is not None:
        study = _filled(study, lookup(PRESETS, study.preset, "preset"))
    study = _filled(study, {"methods": METHODS, "labels": LABELS, "label_unit": "trajectory", "seeds": 3})
    if not study.tasks:
        named = [text.partition("=")[0] for text in study.datasets if "=" in text]
        alone = study.datasets[0] if study.datasets and not named else None
        study = replace(study, tasks=tuple(named or [DEFAULT_TASK if alone is None else find_task_of(alone).name]))
    for name in study.tasks:
        task_of(study, name)
    paths: dict[str, Any] = {
        name: _absolute(name, getattr(study, name), study.tasks) for name in ("datasets", "planners")
    }
    return replace(study, out=study.out.absolute(), preset=None, **paths)


def _filled(study: Study, known: Mapping[str, Any]) -> Study:
    """A study whose fields, and options of its sections, are those that are known where they were left open."""
    empty, filled = Study(out=study.out), {}
    asked_labels = study.labels or study.levels
    for name, value in known.items():
        own, usual = getattr(study, name), getattr(empty, name)
        if isinstance(value, Mapping):
            left = {key: entry for key, entry in value.items() if getattr(own, key) == getattr(usual, key)}
            filled[name] = replace(own, **left)
        elif own == usual and not (name in ("labels", "levels") and asked_labels):
            filled[name] = value
    return replace(study, **filled)


def _absolute(name: str, values: Sequence[str], tasks: Sequence[str]) -> tuple[str, ...]:
    """``TASK=PATH`` of every value; a path alone is that of a single task."""
    found = {}
    for text in values:
        task, equals, place = text.partition("=")
        if not equals and len(tasks) == 1:
            task, place = tasks[0], text
        if not task or not place:
            raise ValueError(f"{name} must be TASK=FOLDER where there are several tasks, got {text!r}")
        lookup(tasks, task, f"task of {name}:")
        found[task] = str(find_run(place).absolute()) if name == "planners" else os.path.abspath(place)
    return tuple(f"{task}={place}" for task, place in found.items())


def read_study(folder: Path) -> Study | None:
    """Reads what an earlier call in a folder asked for, None if there was none.

    Raises:
        RunDirectoryError: if ``study.json`` is damaged.
    """
    run = RunDirectory(folder)
    if not (run.path / FILE).exists():
        return None
    return from_json(Study, run.read_json(FILE), run.path / FILE)


def together(study: Study) -> Study:
    """A complete study and what earlier calls in its folder asked for besides."""
    earlier = read_study(study.out)
    if earlier is None:
        return study
    grown: dict[str, Any] = {
        name: tuple(dict.fromkeys([*getattr(earlier, name), *getattr(study, name)])) for name in GROWS
    }
    return replace(study, seeds=max(study.seeds, earlier.seeds), **grown)


def cells_of(study: Study) -> list[Cell]:
    """Lists the cells of a complete study in the order asked for; repeated names count once.

    Raises:
        ValueError: for unknown methods, or a share or level that there is not.
    """
    for name in study.methods:
        get_method(name)
    for name in ("labels", "demonstrations"):
        for value in getattr(study, name):
            if not 0 < value <= 1:
                raise ValueError(f"{name} must be in (0, 1], got {value:g}")
    return [
        Cell(task, method, labels, share, seed)
        for task in dict.fromkeys(study.tasks)
        for seed in range(study.seeds)
        for share in dict.fromkeys(study.demonstrations)
        for labels in dict.fromkeys([*study.labels, *levels_of(task_of(study, task), study.levels)])
        for method in dict.fromkeys(study.methods)
    ]


def levels_of(task: Task, levels: Sequence[int]) -> list[float]:
    """The shares of labels at some label levels of a task.

    Args:
        task (Task): the task.
        levels (sequence of int): from 1 on.

    Raises:
        ValueError: for a level that the task does not have.
    """
    for level in levels:
        if not 1 <= level <= len(task.label_levels):
            shares = ", ".join(f"{100 * share:g}" for share in task.label_levels)
            has = f"its levels 1 to {len(task.label_levels)} are {shares} %"
            raise ValueError(f"task {task.name!r} has no label level {level}: {has}")
    return [task.label_levels[level - 1] for level in levels]


def task_of(study: Study, name: str) -> Task:
    """The task of a name: registered, or the one that its data set holds.

    Args:
        study (Study): the study.
        name (str): of the task.
    """
    dataset = of_task(study.datasets, name)
    return get_task(name) if dataset is None else find_task_of(dataset, name)


def of_task(values: Sequence[str], task: str) -> str | None:
    """What ``TASK=VALUE`` among some values says for a task.

    Args:
        values (sequence of str): ``TASK=VALUE`` each.
        task (str): name of the task.
    """
    return next((text.partition("=")[2] for text in values if text.startswith(f"{task}=")), None)


def planner_folder(study: Study, cell: Cell) -> Path | None:
    """The run whose planner a cell takes over, None for a method without one.

    Args:
        study (Study): the study.
        cell (Cell): the cell.
    """
    if not get_method(cell.method).plans:
        return None
    given = of_task(study.planners, cell.task)
    name = f"{cell.demonstrations:.15g}-seed{cell.seed % study.planner_seeds}"
    return study.out / "planners" / cell.task / name if given is None else Path(given)


def dataset_of(study: Study, task: str) -> Path:
    """The folder of a task's demonstrations.

    Args:
        study (Study): the study.
        task (str): name of the task.
    """
    return Path(of_task(study.datasets, task) or study.out / "demonstrations" / task)


def train_config(study: Study, cell: Cell, *, planner: bool = False) -> TrainConfig:
    """How a cell is trained, or the planner that it shares: the defaults of method and task are filled in by training.

    Args:
        study (Study): a complete study.
        cell (Cell): one of its cells.

    Keyword Args:
        planner (bool): the planner alone; it knows no label.
    """
    folder = planner_folder(study, cell)
    common: dict[str, Any] = {"dataset": str(dataset_of(study, cell.task)), "task": cell.task}
    if planner:
        seed, labels = cell.seed % study.planner_seeds, LabelConfig(trajectories=cell.demonstrations)
        run = replace(study.run, seed=seed)
        return TrainConfig(out=folder, labels=labels, planner=study.planner, run=run, **common)
    labels = LabelConfig(fraction=cell.labels, unit=study.label_unit, trajectories=cell.demonstrations)
    return TrainConfig(
        out=study.out / cell.folder,
        method=cell.method,
        labels=labels,
        planner=study.planner if folder is None else PlannerConfig(source=folder),
        controller=study.controller,
        execution=study.execution,
        run=replace(study.run, seed=cell.seed),
        **common,
    )


def eval_config(study: Study, cell: Cell) -> EvalConfig:
    """How a cell is rolled out: cells with the next training seed meet other noise, in the same contexts.

    Args:
        study (Study): the study.
        cell (Cell): the cell.
    """
    seed = study.evaluation.seed + NOISE_STEP * cell.seed
    return replace(study.evaluation, seed=seed, threads=1, plugins=study.run.plugins)


def check_study(study: Study) -> list[Cell]:
    """Refuses what cannot be done of a complete study without looking at any data; nothing is written.

    Returns:
        list of Cell: its cells.

    Raises:
        ValueError: for unknown names, shares and numbers out of range, and methods whose networks cannot be built.
        RunDirectoryError: if the folder holds something else, or a study with other settings.
    """
    for name in ("seeds", "record", "planner_seeds"):
        value = getattr(study, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    for name, said in _OWN.items():
        if _option(study, name) != _option(Study(out=study.out), name):
            raise ValueError(f"{name} is not for a study: {said}")
    check_options(study.evaluation)
    contexts = study.evaluation.contexts_file
    if contexts is not None and not Path(contexts).is_file():
        raise ValueError(f"contexts_file: there is no file {contexts}")
    cells = cells_of(study)
    sampling = [name for name in study.methods if not get_method(name).plans]
    if study.execution.strategy == "open_loop" and sampling:
        raise ValueError(
            f"strategy 'open_loop' was asked of {', '.join(sampling)}: a policy of its own executes chunks of actions"
            " and has no other strategy; leave it out of --methods"
        )
    check_folder(study)
    for task in study.tasks:
        for method in study.methods:
            _check_networks(study, Cell(task, method, 1.0, 1.0, 0))
    return cells


def _check_networks(study: Study, cell: Cell) -> None:
    """Refuses a method whose networks cannot be built for a task, or for the planner that is to be shared."""
    task, config = task_of(study, cell.task), train_config(study, cell)
    if config.planner.source is not None and of_task(study.planners, cell.task) is None:  # not trained yet
        config = replace(config, planner=study.planner)
    config = resolve(config, task)
    try:
        build_networks(task, config)
    except ValueError as error:
        read = f"the columns {config.controller.columns!r} of " if get_method(cell.method).plans else ""
        raise ValueError(f"method {cell.method!r} cannot read {read}task {task.name!r}: {error}") from error


def check_folder(study: Study) -> None:
    """Refuses a folder that holds something else, or a study with other settings.

    Raises:
        RunDirectoryError: naming what differs.
    """
    path, earlier = study.out, read_study(study.out)
    if earlier is not None:
        fixed = {name: getattr(study, name) for name in (*GROWS, "out", "seeds")}
        changed = changed_options(replace(earlier, **fixed, run=replace(earlier.run, plugins=study.run.plugins)), study)
        for name in ("datasets", "planners"):
            was, now = getattr(earlier, name), getattr(study, name)
            both = {text.partition("=")[0] for text in was} | {text.partition("=")[0] for text in now}
            changed += (
                [name]
                if any(
                    of_task(was, task) != of_task(now, task)
                    for task in both
                    if {task} <= {*earlier.tasks} & {*study.tasks}
                )
                else []
            )
        if changed:
            told = ", ".join(f"{name} ({_option(earlier, name)})" for name in changed)
            raise RunDirectoryError(f"{path} holds a study with another {told}; choose another --out")
        return
    if path.exists() and not path.is_dir():
        raise RunDirectoryError(f"{path} is a file; choose another --out")
    # what a study leaves that was killed before it came to write its options
    own = ("lock", "demonstrations", f".{FILE}.")
    if path.exists() and not all(entry.name.startswith(own) for entry in path.iterdir()):
        raise RunDirectoryError(f"{path} is not empty and no folder of `koap curve`; choose another --out")


def _option(study: Study, name: str) -> Any:
    value: Any = study
    for part in name.split("."):
        value = getattr(value, part)
    return ", ".join(map(str, value)) if isinstance(value, tuple) else value
