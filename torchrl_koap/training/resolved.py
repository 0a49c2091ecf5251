# This source code is licensed under the MIT license found in the LICENSE file.
"""Options of a training with every name looked up and every default filled in."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, cast

from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, controller_view
from torchrl_koap.data.label_budget import Unit
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.device import PRECISIONS
from torchrl_koap.runs.progress import check_logger
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import HISTORY, HORIZON, Task
from torchrl_koap.training.datasets import find_task_of
from torchrl_koap.training.diffusion_builders import SIZES
from torchrl_koap.training.method import COEFFICIENTS, Method, loss_coefficients
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.validation import default_fraction

# defaults for data that lack labels or came without an environment, and for all others
ALL_LABELS, LABEL_FRACTION = 1.0, 0.02


@dataclass(frozen=True)
class ResolvedConfig:
    """A :class:`TrainConfig` that leaves nothing open: what planner and controller are trained by.

    Args:
        options (TrainConfig): with the task's defaults where nothing was asked for.
        task (Task): the task.
        method (Method): the method, with the decoder asked for.
        teacher (Method, optional): the method that labels the rest of the data for it.
        budget (LabelBudget): which labels may be seen.
        planner (dict): what :func:`~torchrl_koap.training.diffusion_builders.build_planner` takes.
        controller (dict): what :func:`~torchrl_koap.training.builders.build_controller` takes.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training import TrainConfig, resolve
        >>> resolved = resolve(TrainConfig(out=Path("runs/koap"), label_fraction=0.05))
        >>> resolved.task.name, resolved.method.name, resolved.budget.fraction, resolved.options.steps
        ('avoiding', 'koap', 0.05, 5000)
    """

    options: TrainConfig
    task: Task
    method: Method
    teacher: Method | None
    budget: LabelBudget
    planner: dict[str, Any]
    controller: dict[str, Any]

    @property
    def columns(self) -> tuple[int, ...]:
        """State columns that the controller reads."""
        return self.task.controller_columns(self.options.controller_state)

    def controller_view(self, data: TensorDictBase) -> TensorDictBase:
        """Flat data ``[N]`` as the controller sees them: its columns, and actions as distances to their targets."""
        return controller_view(data, self.columns, action_targets=self.task.targets)

    def with_labels_of(self, data: TensorDictBase) -> ResolvedConfig:
        """The same with the share of labels that is the default for these data, if none was asked for."""
        if self.options.label_fraction is not None:
            return self
        every = self.task.env is None or not data["has_action"].all()
        share = ALL_LABELS if every else LABEL_FRACTION
        options = replace(self.options, label_fraction=share)
        return replace(self, options=options, budget=_budget(options))


def resolve(config: TrainConfig, task: Task | None = None) -> ResolvedConfig:
    """Looks every name up and fills every default in, once; plugins must have been imported.

    Args:
        config (TrainConfig): what is asked for.
        task (Task, optional): the task, registered or not. Default: the one of the data set.

    Returns:
        ResolvedConfig: nothing in it is left open.

    Raises:
        ValueError: for unknown names, numbers out of range, and options that exclude each other.
        RunDirectoryError: if ``planner_from`` is no finished run.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training import TrainConfig, resolve
        >>> resolved = resolve(TrainConfig(out=Path("run"), task="avoiding", method="linear"))
        >>> resolved.options.steps, resolved.method.closed_form, resolved.columns
        (5000, True, (0, 1))
    """
    task = find_task_of(config.dataset, config.task) if task is None else task
    options = replace(_with_task_defaults(config, task), task=task.name)
    method = _method(options)
    if method.has_planner and options.planner_from is None and options.observed_frames is None:
        options = replace(options, observed_frames=task.defaults.view.get("observed_frames"))
    _check(options, method, task)
    if options.planner_from is not None:
        planner = RunDirectory(options.planner_from).read_entry("config.json", "planner")
    else:
        planner = _planner_entry(options, task, method)
    preset = options.preset or _own_preset(method, task)
    if preset == "default" and not task.delta_actions and not task.targets:
        preset = "absolute"
    controller: dict[str, Any] = {
        "method": options.method,
        "decoder": options.decoder,
        "preset": preset,
        "state": options.controller_state if method.has_planner else "all",
    }
    if method.columns is not None:
        controller["columns"] = method.columns(task)
    return ResolvedConfig(
        options=options,
        task=task,
        method=method,
        teacher=get_method(method.teacher) if method.teacher else None,
        budget=_budget(options),
        planner=planner,
        controller=controller,
    )


def _own_preset(method: Method, task: Task) -> str:
    """The preset where none is asked for: the task's for its own method, else the method's."""
    own = task.defaults.preset if method.name == task.defaults.method else None
    if own is not None and own not in method.presets:
        has = list(method.presets)
        raise ValueError(f"task {task.name!r} asks for preset {own!r}, method {method.name!r} has {has}")
    return own or method.presets[0]


def _with_task_defaults(options: TrainConfig, task: Task) -> TrainConfig:
    own = task.defaults.planner if options.denoiser is None else {}  # a network asked for comes with its own sizes
    denoiser = options.denoiser or own.get("denoiser", "unet")
    defaults: dict[str, Any] = (
        dict(lookup(SIZES, denoiser, "denoiser"))
        | dict(own)
        | {
            "denoiser": denoiser,
            "method": task.defaults.method,
            "steps": task.defaults.planner_steps,
            "episodes": task.defaults.demonstrations,
            "channels": task.defaults.channels,
            "validation_fraction": default_fraction(task),
        }
    )
    return replace(options, **{name: value for name, value in defaults.items() if getattr(options, name) is None})


def _method(options: TrainConfig) -> Method:
    method = get_method(options.method, options.decoder)
    if options.preset is not None:
        lookup(PRESETS, options.preset, "preset")
        if options.preset not in method.presets:
            has = list(method.presets)
            raise ValueError(f"method {options.method!r} has no preset {options.preset!r}, it has {has}")
    return method


_AT_LEAST_ONE = ("batch_size", "controller_batch_size", "checkpoint_every", "candidates", "denoiser_width")


def _check(options: TrainConfig, method: Method, task: Task) -> None:
    check_logger(options.logger)
    for name in COEFFICIENTS:
        value = getattr(options, name)
        if value is not None and name not in loss_coefficients(method):
            raise ValueError(f"{name} was given, but no loss of method {options.method!r} has it")
        if value is not None and value < 0:
            raise ValueError(f"{name} must be >= 0, got {value}")
    if not method.has_planner and options.planner_from is not None:
        raise ValueError(f"method {options.method!r} is a policy of its own and has no planner to take over")
    if options.observed_frames is not None and not method.has_planner:
        raise ValueError(f"observed_frames is the planner's, which method {options.method!r} does not have")
    if options.observed_frames not in (None, *range(1, HISTORY + 1)):
        raise ValueError(f"observed_frames must be 1 to {HISTORY}, got {options.observed_frames}")
    if options.steps < 1 or options.controller_steps < 0:
        raise ValueError(f"steps must be >= 1, got {options.steps} and {options.controller_steps}")
    for name in ("planner_learning_rate", "controller_learning_rate"):
        if not 0 < getattr(options, name) < math.inf:
            raise ValueError(f"{name} must be a number above 0, got {getattr(options, name)}")
    if options.label_fraction is not None and not 0 < options.label_fraction <= 1:
        raise ValueError(f"label_fraction: a fraction must be in (0, 1], got {options.label_fraction}")
    if method.has_planner and task.defaults.view.get("neighbor_recovery") and options.batch_size == 1:
        raise ValueError(
            f"batch_size: the neighbor_recovery of task {task.name!r} looks for neighbours in a batch of two or more,"
            " got 1"
        )
    lookup(PRECISIONS, options.precision or "float32", "precision")
    if options.seed < 0:
        raise ValueError(f"seed must be >= 0, got {options.seed}")
    if not 0 <= (options.validation_fraction or 0) < 1:
        raise ValueError(f"validation_fraction must be in [0, 1), got {options.validation_fraction}")
    for name in _AT_LEAST_ONE:
        value = getattr(options, name)
        if value is not None and value < 1:
            raise ValueError(f"{name} must be >= 1, got {value}")
    if not 0 < options.observation_fraction <= 1:
        raise ValueError(f"observation_fraction: a fraction must be in (0, 1], got {options.observation_fraction}")


def _budget(options: TrainConfig) -> LabelBudget:
    if options.label_episodes is not None:
        if options.label_count is not None or options.label_unit != "trajectory":
            raise ValueError("label_episodes are trajectories of their own choice: no label_count or label_unit")
        return LabelBudget(episodes=options.label_episodes)
    unit = cast("Unit", options.label_unit)  # another one is refused there
    if options.label_count is not None:
        return LabelBudget(count=options.label_count, unit=unit, seed=options.seed)
    fraction = LABEL_FRACTION if options.label_fraction is None else options.label_fraction
    return LabelBudget(fraction=fraction, unit=unit, seed=options.seed)


def _planner_entry(options: TrainConfig, task: Task, method: Method) -> dict[str, Any]:
    entry = {
        "denoiser": options.denoiser,
        "channels": list(options.channels),
        "history": options.observed_frames or HISTORY,
        "horizon": HORIZON,
        "relative": task.defaults.relative,
    }
    if options.denoiser_width is not None:
        entry["width"] = options.denoiser_width
    if method.has_planner and task.defaults.view.get("forecast", task.env is None):
        entry["forecast"] = True
    return entry
