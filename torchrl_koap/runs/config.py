# This source code is licensed under the MIT license found in the LICENSE file.
"""The options of a training, in sections; ``config.json`` of a run holds the same with every default filled in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from torchrl_koap.data import LabelBudget
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.execution.execution import ExecutionConfig
from torchrl_koap.runs.device import PRECISIONS, check_machine
from torchrl_koap.runs.plugins import Plugins, absolute_files
from torchrl_koap.runs.progress import LOGGERS
from torchrl_koap.runs.run_directory import find_run
from torchrl_koap.tasks import HISTORY

COLUMNS = ("robot", "all", "related")
# conditions on numbers, in words and as a function
_POSITIVE, _COUNT, _FROM_0 = ("> 0", lambda v: v > 0), (">= 1", lambda v: v >= 1), (">= 0", lambda v: v >= 0)
_FRAMES = (f">= 1 and <= {HISTORY}", lambda v: 1 <= v <= HISTORY)
_SHARE, _PART = ("> 0 and <= 1", lambda v: 0 < v <= 1), (">= 0 and < 1", lambda v: 0 <= v < 1)
_WHOLE = (_COUNT, _FROM_0, _FRAMES)

_Options = TypeVar("_Options")


@dataclass(frozen=True)
class LabelConfig:
    """Which labels of the data may be seen; by default all.

    Attributes:
        fraction: share of the units that keep their actions.
        count: number of them instead of a share.
        episodes: these trajectories instead of a random choice, as `koap suggest` names them.
        unit: what is drawn: "trajectory", "window" (the unit of the first public code) or "transition".
        trajectories: share of the trajectories that are used at all; those with labels come first.

    Raises:
        ValueError: for a number out of range, or two ways to choose at once.
    """

    fraction: float | None = None
    count: int | None = None
    episodes: tuple[int, ...] = ()
    unit: str = "trajectory"
    trajectories: float = 1.0

    def __post_init__(self):
        self.budget()
        _check("labels", self, trajectories=_SHARE)

    def budget(self, seed: int = 0) -> LabelBudget:
        """Makes the label budget with these options."""
        drawn: dict[str, Any] = {"episodes": self.episodes or None, "unit": self.unit}
        return LabelBudget(fraction=self.fraction, count=self.count, seed=seed, **drawn)


@dataclass(frozen=True)
class PlannerConfig:
    """The planner: its network and its training. None: the task's default, else the network's.

    Attributes:
        steps: updates at most.
        network: "unet", "mlp", "objects" (for tasks with bodies in their state) or one that a plugin registers.
        width: channels of the first level of "unet" (the second has twice as many), hidden width of "mlp", or width of
            a token of "objects".
        octaves: octaves of the Fourier features of the observed states; 0: the states themselves.
        batch_size: windows per update.
        learning_rate: peak learning rate.
        frames: observed frames that it reads, 1 or 2 (default for own data: as `koap convert` says).
        held_out: share of the trajectories that it is not trained on, those without labels first. Training keeps the
            weights that plan them best, and `koap eval` without an environment evaluates plans on them (default: 0.1;
            0 for a method that samples actions).
        source: run whose planner is used instead of training one, or pretrained:NAME.

    Raises:
        ValueError: for a number out of range.
    """

    steps: int | None = None
    network: str | None = None
    width: int | None = None
    octaves: int | None = None
    batch_size: int | None = None
    learning_rate: float | None = None
    frames: int | None = None
    held_out: float | None = None
    source: Path | None = None

    def __post_init__(self):
        _check("planner", self, steps=_COUNT, width=_COUNT, batch_size=_COUNT, frames=_FRAMES)
        _check("planner", self, learning_rate=_POSITIVE, held_out=_PART, octaves=_FROM_0)
        if self.source is not None:
            object.__setattr__(self, "source", find_run(self.source))


@dataclass(frozen=True)
class ControllerConfig:
    """The controller, which turns states into actions. None: the method's default, else the task's.

    Attributes:
        preset: variant of KOAP: "default", "delayed", "absolute", "semi_supervised", "scene" or "paper".
        steps: updates (default: 500); with 0 only a closed form is fitted.
        columns: state columns that it reads: those of the "robot", "all" as in the paper, or "related" (all, and the
            relative positions that the planner reads).

    Raises:
        ValueError: for a number out of range.
    """

    preset: str | None = None
    steps: int | None = None
    columns: str | None = None

    def __post_init__(self):
        _check("controller", self, steps=_FROM_0)
        if self.columns is not None:
            lookup(COLUMNS, self.columns, "controller.columns")


@dataclass(frozen=True)
class RunConfig:
    """The process of a training: seed, machine, log.

    Attributes:
        seed: seed of label choice, initialisation and batches.
        threads: torch threads (default: OMP_NUM_THREADS where it is set, else 1).
        device: "cpu" or "cuda".
        precision: of the matrix products in the planner's training: "float32", "bfloat16" (several times faster if the
            processor has units for it, else many times slower), or "auto": bfloat16 if it has.
        logger: "csv" (metrics.csv alone), or also "wandb" (offline unless WANDB_MODE is set) or "tensorboard".
        resume: resume an interrupted run; options that are not given keep their first values.
        plugins: modules that register tasks, methods or pictures; imported before anything else, and again by every
            command that reads the run, which records absolute paths of files.

    Raises:
        ValueError: for a number out of range, or an unknown device, precision or logger.
    """

    seed: int = 0
    threads: int | None = None
    device: str = "cpu"
    precision: str = "auto"
    logger: str = "csv"
    resume: bool = False
    plugins: Plugins = ()

    def __post_init__(self):
        _check("run", self, seed=_FROM_0)
        object.__setattr__(self, "plugins", absolute_files(self.plugins))
        check_machine(self.threads, self.device)
        lookup(PRECISIONS, self.precision, "precision")
        lookup(LOGGERS, self.logger, "logger")


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        dataset: folder with demonstrations: of `koap demos`, `koap convert` or save_demonstrations, of D3IL raw
            pickles, or a LeRobot data set.
        out: run directory to write.
        task: name of the task (default: that of the data set).
        method: "koap", "mpc" (plans followed by an identified model of the robot), "linear" (ridge on raw frames),
            "dd" (supervised inverse dynamics), "dp" (Diffusion Policy), or another name in
            torchrl_koap.training.methods.METHODS, also of a plugin (default: the task's).
        labels: which labels may be seen.
        planner: its network and training (default: the task's).
        controller: its variant and training (default: the method's).
        execution: how plans become actions (default: the task's).
        run: seed, machine, log.

    Raises:
        TypeError: for a section that is not of its class, such as a dictionary.
    """

    dataset: str | None = None
    out: Path
    task: str | None = None
    method: str | None = None
    labels: LabelConfig = field(default_factory=LabelConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    controller: ControllerConfig = field(default_factory=ControllerConfig)
    execution: ExecutionConfig = field(default_factory=ExecutionConfig)
    run: RunConfig = field(default_factory=RunConfig)

    def __post_init__(self):
        object.__setattr__(self, "out", Path(self.out))  # accepts a string in Python
        for section in fields(self):
            kind: Any = section.default_factory
            given = getattr(self, section.name)
            if isinstance(kind, type) and not isinstance(given, kind):
                raise TypeError(f"{section.name} must be a {kind.__name__}, got {given!r}")


def _check(section: str, config: object, **wanted: tuple[str, Callable[[float], bool]]) -> None:
    """Raises a ValueError for numbers that do not meet their condition; None is skipped."""
    for name, (words, fits) in wanted.items():
        value = getattr(config, name)
        if value is None:
            continue
        if not isinstance(value, (int, float, np.number)):
            raise ValueError(f"{section}.{name} must be a number {words}, got {value!r}")
        if not (math.isfinite(value) and fits(value)):
            raise ValueError(f"{section}.{name} must be {words}, got {value}")
        if (words, fits) in _WHOLE:  # torch accepts neither 1e4 nor NumPy numbers as counts
            if value % 1:
                raise ValueError(f"{section}.{name} must be a whole number, got {value}")
            object.__setattr__(config, name, int(value))


def given_options(given: Any, kind: type[_Options]) -> _Options:
    """Returns the given options, or the defaults of their class if they are None.

    Raises:
        TypeError: for anything else, such as a number or a folder; the message names the class.
    """
    if given is None:
        return kind()
    if not isinstance(given, kind):
        raise TypeError(f"options must be {kind.__name__}(...), got {type(given).__name__} {given!r}")
    return given
