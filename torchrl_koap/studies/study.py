# This source code is licensed under the MIT license found in the LICENSE file.
"""A study: tasks x methods x labels x demonstrations x seeds, and the options that its cells share."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torchrl_koap.data.sources import DEFAULT_TASK, find_task_of
from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.evaluation.closed_loop import choose_contexts, find_environment
from torchrl_koap.evaluation.policies import trained_policy
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.execution import ExecutionConfig
from torchrl_koap.runs.config import ControllerConfig, LabelConfig, PlannerConfig, RunConfig, TrainConfig
from torchrl_koap.runs.config_files import fill_in
from torchrl_koap.runs.plugins import load_plugins
from torchrl_koap.runs.run_directory import find_run
from torchrl_koap.studies.cells import NOISE_STEP, Cell
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.on_disk import planner_of_source
from torchrl_koap.training.trained import Trained, build_networks
from torchrl_koap.vision.encoder import cameras_of

PAPER_TASKS = ("avoiding", "aligning", "sorting", "po_sorting", "stacking_unobserved_joints")
# options of a Study by name, with a mapping for each section
USUAL: dict[str, Any] = {
    "methods": (
        *("koap", "koap_untrained", "koap_labelled_only", "linear_steps", "linear", "dd", "vae", "lapo", "dp"),
        *("relabel", "nonlinear", "pretrain"),
    ),
    "labels": (0.01, 0.02, 0.05, 0.1, 0.25),
    "label_unit": "trajectory",
    "demonstrations": (1.0,),
    "seeds": 3,
}
_EVERY_DEMONSTRATION = {"held_out": 0.0}  # trains the planner, as in the paper
_TABLE_1: dict[str, Any] = {
    "tasks": PAPER_TASKS,
    "methods": ("koap", "koap_paper", "koap_untrained", "linear_steps", "pca", "dd", "vae", "lapo", "dp"),
    "labels": (),
    "levels": (1, 2, 3, 4, 5),
    "label_unit": "window",
    "planner": _EVERY_DEMONSTRATION,
}
PRESETS: dict[str, dict[str, Any]] = {
    "table1": _TABLE_1,
    "table2": _TABLE_1
    | {
        "tasks": ("avoiding", "stacking_unobserved_joints"),
        "methods": (
            *("koap", "koap_paper", "koap_sgd", "koap_labelled_only", "koap_untrained", "nonlinear", "pretrain"),
            "relabel",
        ),
    },
    "demonstrations": {
        "tasks": ("avoiding",),
        "methods": ("koap", "koap_paper", "koap_untrained", "pca", "linear_steps", "dd"),
        "labels": (0.01,),
        "demonstrations": (0.1, 0.25, 0.5, 1.0),
        "planner": _EVERY_DEMONSTRATION,
    },
    # for a first look: too few rollouts and seeds to be cited
    "quick": _TABLE_1
    | {
        "levels": (1,),
        "record": 48,
        "seeds": 1,
        "planner": _EVERY_DEMONSTRATION | {"network": "mlp", "steps": 2000, "width": 256, "batch_size": 128},
        "controller": {"steps": 200},
        "evaluation": {"episodes": 10},
    },
}
# options of the sections that a study sets itself, and the reason
_ONE_THREAD = "a cell has one thread; --workers sets how many run at a time"
DECIDED = {
    "run.seed": "cells have the seeds 0, 1, ...; --seeds sets their number",
    "run.resume": "it always resumes",
    "run.threads": _ONE_THREAD,
    "planner.source": "name runs with --planners",
    "evaluation.out": "a cell is evaluated in its own folder",
    "evaluation.dataset": "a cell is evaluated on what it was trained on",
    "evaluation.threads": _ONE_THREAD,
    "evaluation.plugins": "name them with --run.plugin",
    "evaluation.execution": "name its options with --execution",
}


@dataclass(frozen=True, kw_only=True)
class Study:
    """Measure success against the number of labels: tasks x methods x shares of labels x seeds.

    Attributes:
        out: folder of the study; the same command resumes an interrupted study, and may add tasks, methods, shares or
            seeds.
        preset: a comparison of the paper, "table1" (methods), "table2" (variants), "demonstrations" (planner and
            controller use a share of them) or "quick" (a small table1); it fills in options that are not given.
        tasks: names of tasks (default: that of the data set, else "avoiding").
        datasets: folder of the demonstrations of a single task, or TASK=FOLDER for each (default: scripted ones are
            recorded in the folder, once for all cells).
        record: number of scripted demonstrations (default: that of the task).
        methods: names in torchrl_koap.training.methods.METHODS.
        labels: shares of the units that keep their labels; 1 is all of them, not one as for `koap train`.
        levels: label levels of the paper for every task (1: fewest labels), instead of or with labels.
        label_unit: "trajectory", "window" (the unit of the first public code) or "transition".
        demonstrations: shares of the demonstrations that planner and controller each use (default: 1). The controller's
            include all with labels, the planner's are the same for every draw of labels.
        seeds: number of seeds of label choice and training (default: 3).
        planners: finished run, or pretrained:NAME, whose planner all cells of a task share, or TASK=RUN for each
            (default: one is trained for each seed). It must be trained on the same data; this is not checked.
        planner: network and training of planners, and of methods that sample actions without a planner.
        controller: training of every controller.
        execution: how plans become actions.
        evaluation: rollouts of every cell, one thread each; cells with the same seed have the same contexts and noise.
        run: processor, precision and plugins of every training.
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
    demonstrations: tuple[float, ...] = ()
    seeds: int | None = None
    planners: tuple[str, ...] = ()
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)
    evaluation: EvalConfig = field(default_factory=EvalConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self):
        object.__setattr__(self, "out", Path(self.out))  # accepts a string in Python

    def given_dataset(self, task: str) -> str | None:
        """Returns the data set that was named for a task, or None."""
        return _of_task(self.datasets, task)

    def given_planner(self, task: str) -> str | None:
        """Returns the run that was named for a task, whose planner is shared, or None."""
        return _of_task(self.planners, task)

    def task(self, name: str) -> Task:
        """Returns a task by name: the registered one, or that of its data set."""
        dataset = self.given_dataset(name)
        return get_task(name) if dataset is None else find_task_of(dataset, name)

    def dataset_folder(self, task: str) -> Path:
        """Returns the folder of a task's demonstrations."""
        return Path(self.given_dataset(task) or self.out / "demonstrations" / task)

    def has_data(self, task: str) -> bool:
        """Returns whether the demonstrations of a task were named, or are recorded already."""
        return self.given_dataset(task) is not None or (self.dataset_folder(task) / "ted").exists()

    def planner_folder(self, cell: Cell) -> Path | None:
        """Returns the run whose planner a cell uses, None for a method without one."""
        if not get_method(cell.method).plans:
            return None
        own = self.out / f"planners/{cell.task}/{cell.demonstrations:.15g}-seed{cell.seed}"
        return Path(self.given_planner(cell.task) or own)

    def cells(self) -> list[Cell]:
        """Lists the cells of a complete study in the given order; repeated names count once."""
        for name in self.methods:
            get_method(name)
        for name, shares in (("labels", self.labels), ("demonstrations", self.demonstrations)):
            for value in shares:
                if not 0 < value <= 1:
                    raise ValueError(f"{name} must be shares in (0, 1], got {value:g}")
        return [
            Cell(task, method, labels, share, seed)
            for task in dict.fromkeys(self.tasks)
            for shares in [self._labels_of(self.task(task))]
            for seed in range(self.seeds)
            for share in dict.fromkeys(self.demonstrations)
            for labels in shares
            for method in dict.fromkeys(self.methods)
        ]

    def _labels_of(self, task: Task) -> tuple[float, ...]:
        """Returns the shares of labels for a task: the given ones, and those of the levels."""
        shares = task.label_levels
        for level in self.levels:
            if not 1 <= level <= len(shares):
                has = f"its levels 1 to {len(shares)} are {', '.join(f'{100 * share:g}' for share in shares)} %"
                raise ValueError(f"task {task.name!r} has no label level {level}: {has}")
        return union(self.labels, [shares[level - 1] for level in self.levels])

    def planner_config(self, cell: Cell) -> TrainConfig:
        """Returns the options for training the planner that all cells of a seed share, which sees no labels."""
        return TrainConfig(
            out=self.planner_folder(cell),
            dataset=str(self.dataset_folder(cell.task)),
            task=cell.task,
            labels=LabelConfig(trajectories=cell.demonstrations),
            planner=self.planner,
            run=replace(self.run, seed=cell.seed, threads=1),
        )

    def train_config(self, cell: Cell) -> TrainConfig:
        """Returns the options for training a cell; training fills in the defaults of method and task."""
        folder = self.planner_folder(cell)
        return TrainConfig(
            out=self.out / cell.folder,
            dataset=str(self.dataset_folder(cell.task)),
            task=cell.task,
            method=cell.method,
            labels=LabelConfig(fraction=cell.labels, unit=self.label_unit, trajectories=cell.demonstrations),
            planner=self.planner if folder is None else PlannerConfig(source=folder),
            controller=self.controller,
            execution=self.execution,
            run=replace(self.run, seed=cell.seed, threads=1),
        )

    def eval_config(self, cell: Cell) -> EvalConfig:
        """Returns the options for evaluating a cell: training seeds have the same contexts, but different noise."""
        seed = self.evaluation.seed + NOISE_STEP * cell.seed
        return replace(self.evaluation, seed=seed, threads=1, plugins=self.run.plugins)


def _of_task(values: Sequence[str], task: str) -> str | None:
    """Returns VALUE of the first ``TASK=VALUE`` for a task, or None."""
    return next((text.partition("=")[2] for text in values if text.startswith(f"{task}=")), None)


def complete(study: Study, plugins: Sequence[str] = ()) -> Study:
    """Fills in the defaults of preset and library, adds ``plugins`` of earlier calls, and makes paths absolute."""
    plugins = union(plugins, study.run.plugins)
    load_plugins(plugins)
    usual = USUAL | ({} if study.preset is None else lookup(PRESETS, study.preset, "preset"))
    if study.labels or study.levels:  # given ones replace the usual ones of both kinds
        usual |= {"labels": (), "levels": ()}
    record, asked, study = study.record, study.planner, fill_in(study, usual)
    study = replace(
        study,
        out=study.out.absolute(),
        preset=None,
        tasks=study.tasks or _tasks_of(study.datasets),
        run=replace(study.run, plugins=plugins),
    )
    datasets = [f"{task}={os.path.abspath(path)}" for task, path in _by_task("datasets", study.datasets, study.tasks)]
    runs = [f"{task}={find_run(run).absolute()}" for task, run in _by_task("planners", study.planners, study.tasks)]
    study = replace(study, datasets=tuple(datasets), planners=tuple(runs))
    for name in study.tasks:
        study.task(name)  # raises for an unknown task
    if record is not None and all(map(study.given_dataset, study.tasks)):
        raise ValueError(f"record {record} has no effect: all demonstrations are given with --datasets")
    trains = any(study.given_planner(task) is None for task in study.tasks)
    if asked != PlannerConfig() and not trains and all(get_method(name).plans for name in study.methods):
        raise ValueError("planner options have no effect: all planners are given with --planners, none is trained")
    return study


def _tasks_of(datasets: Sequence[str]) -> tuple[str, ...]:
    """Returns the tasks named with the data sets, else those that the data sets hold."""
    named = tuple(text.partition("=")[0] for text in datasets if "=" in text)
    if named or not datasets:
        return named or (DEFAULT_TASK,)
    return tuple(dict.fromkeys(find_task_of(folder).name for folder in datasets))


def _by_task(name: str, values: Sequence[str], tasks: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yields task and path of every ``TASK=PATH``; the only value for a single task may be just a path."""
    seen: set[str] = set()
    for text in values:
        task, equals, path = text.partition("=")
        if not equals and len(tasks) == len(values) == 1:
            task, path = tasks[0], text
        if not task or not path:
            raise ValueError(f"{name} must be TASK=FOLDER if there are several tasks or values, got {text!r}")
        lookup(tasks, task, f"task of {name}:")
        if task in seen:
            raise ValueError(f"{name} names task {task!r} twice: give one folder per task")
        seen.add(task)
        yield task, path


def union(one: Sequence[Any], other: Sequence[Any]) -> tuple[Any, ...]:
    """Returns the entries of one sequence, then those of the other, each once."""
    return tuple(dict.fromkeys([*one, *other]))


def check_study(study: Study) -> list[Cell]:
    """Checks a complete study without reading data and returns its cells; a ValueError says what cannot be done."""
    for name, number in (("seeds", study.seeds), ("record", study.record)):
        if number is not None and number < 1:
            raise ValueError(f"{name} must be >= 1, got {number}")
    for name, why in DECIDED.items():
        section, field = name.split(".")
        config = getattr(study, section)
        if getattr(config, field) != getattr(type(config)(), field):
            raise ValueError(f"{name} is not for a study: {why}")
    for task in study.tasks:  # evaluation would refuse these only after all training
        choose_contexts(study.task(task), study.evaluation)
        if study.evaluation.env is not None:
            find_environment(study.task(task), study.evaluation, cameras_of(study.given_dataset(task)))
    cells = study.cells()
    for task in study.tasks:
        for method in study.methods:
            _check_networks(study, Cell(task, method, 1.0, 1.0, 0))
    return cells


def _check_networks(study: Study, cell: Cell) -> None:
    """Raises a ValueError if networks or policy of a method cannot be built for a task or the shared planner."""
    task, config = study.task(cell.task), study.train_config(cell)
    if config.planner.source is not None and study.given_planner(cell.task) is None:  # not trained yet
        config = replace(config, planner=study.planner)
    config = resolve(config, task)
    if config.planner.source is not None:
        planner_of_source(task, config)
    try:
        networks = build_networks(task, config)
    except ValueError as error:
        read = f"the columns {config.controller.columns!r} of " if get_method(cell.method).plans else ""
        raise ValueError(f"method {cell.method!r} cannot read {read}task {task.name!r}: {error}") from error
    trained_policy(Trained(task, config, *networks), study.evaluation.execution)
