# This source code is licensed under the MIT license found in the LICENSE file.
"""What a training is asked to do, and the same with every default filled in and every name looked up."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, controller_view
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS
from torchrl_koap.tasks import HISTORY, HORIZON, WINDOW, Task
from torchrl_koap.training.datasets import find_task_of
from torchrl_koap.training.methods import Method, get_method
from torchrl_koap.training.plugins import Plugins
from torchrl_koap.training.released_settings import POLICY, Released, get_released
from torchrl_koap.training.run_directory import RunDirectory
from torchrl_koap.training.validation import default_fraction

LABEL_FRACTION, ALL_LABELS = 0.02, 1.0  # defaults for data with all labels, and for data that lack some


@dataclass
class TrainConfig:
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        out: run directory to write.
        task: name of the task (default: that of the data set, if it says so; else "avoiding").
        dataset: "scripted", or a folder: written by `koap demos`, `koap convert` or save_demonstrations, of D3IL raw
            pickles, or a LeRobot data set.
        label_fraction: share of the trajectories, windows or transitions that keep their actions (default: 0.02; all
            labels that there are, where data lack some).
        label_count: number of them instead of a share.
        label_episodes: these trajectories instead of a random choice, as `koap suggest` names them.
        label_unit: "trajectory", "window" (the paper's levels) or "transition".
        seed: seed of label choice, initialisation and batches.
        observation_fraction: share of the trajectories that are used at all; those with labels come first.
        validation_fraction: share of the trajectories that the planner never sees, those without labels first, for
            `koap eval` to judge its plans by (default: 0.1 for a task without an environment, else none).
        method: "koap", "linear" (ridge on raw frames), "dd" (supervised inverse dynamics), "dp" (Diffusion Policy), or
            another name in torchrl_koap.training.methods.METHODS, those that plugins register included.
        released_settings: the unequal network, learning rate and updates that the first public code has for the method.
        epochs: with released settings, epochs instead of the first code's.
        preset: variant of KOAP: "default", "semi_supervised", "paper" or "released" (default: the method's own).
        decoder: "ridge" (closed form on frozen latent actions) or "sgd" (trained with the rest); default: the method's.
        steps: planner updates (default: that of the task); a number below controller_steps shortens that too.
        controller_steps: controller updates.
        batch_size: windows per planner update.
        controller_batch_size: windows per controller update.
        planner_learning_rate: peak learning rate of the planner.
        controller_learning_rate: peak learning rate of the controller.
        denoiser: "unet", "mlp", "film" (an mlp that the condition also scales and shifts), "transformer" or "released"
            (11.9 M parameters).
        denoiser_width: hidden width of "mlp" and "transformer" (default: 256 and 64).
        denoiser_depth: their number of residual layers (default: 3).
        condition_octaves: octaves of the Fourier features of what was observed (default: 4).
        dropout: share of the hidden units of "mlp" dropped in training (default: 0).
        planner_weight_decay: decoupled weight decay of the planner (default: 1e-4).
        first_steps_weight: weight of the first planned step in the planner's loss against the last one's (default: 1).
        precision: "float32", or "bfloat16" for the matrix products of the planner's training: several times quicker
            where the processor has them (default: float32).
        candidates: plans sampled whenever one is due at evaluation, unless told otherwise there (default: 1).
        channels: widths of the U-Net's levels (default: the task's).
        schedule: "squared_cosine", "linear" or "flow".
        prediction: "sample", "epsilon" or "velocity".
        relative: plan displacements from the current state instead of states (default: the task's).
        relations: tell the planner where the tool is as seen from the objects (tasks with objects).
        controller_state: what the controller reads, "robot" (the robot's own columns) or "all" (KOAP's configurations).
        recovery_sigma: typical shift of the recovery augmentation in m or rad (default: the task's); 0 turns it off.
        scene_shift: typical displacement (m) of whole scenes, for tasks whose place on the table does not matter.
        scene_turn: typical angle (rad) by which such scenes are turned.
        exchange: exchange objects that are alike.
        solver: solver used at evaluation unless told otherwise.
        solver_steps: its number of steps.
        planner_from: run directory whose planner is taken over instead of training one.
        episodes: number of scripted demonstrations (default: that of the task).
        threads: torch threads.
        device: "cpu" or "cuda".
        checkpoint_every: updates between two checkpoints, from which --resume goes on.
        resume: go on with an interrupted run; options left at their defaults are those it was started with.
        logger: "csv" (metrics.csv alone) or "wandb" as well (offline unless WANDB_MODE says otherwise).
        analysis: measure the action error on unlabelled demonstrations (reads labels outside the budget, afterwards).
        plugins: modules that register tasks, methods or pictures; imported before anything else, and again by whatever
            reads the run.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training import TrainConfig, train
        >>> config = TrainConfig(out=Path("runs/koap"), task="avoiding", label_fraction=0.05)
        >>> train(config)  # doctest: +SKIP
    """

    out: Path
    task: str | None = None
    dataset: str = "scripted"
    label_fraction: float | None = None
    label_count: int | None = None
    label_episodes: tuple[int, ...] | None = None
    label_unit: str = "trajectory"
    observation_fraction: float = 1.0
    validation_fraction: float | None = None
    seed: int = 0
    method: str = "koap"
    released_settings: bool = False
    epochs: int | None = None
    preset: str | None = None
    decoder: str | None = None
    steps: int | None = None
    controller_steps: int = 500
    batch_size: int = 128
    controller_batch_size: int = 256
    planner_learning_rate: float = 3e-3
    controller_learning_rate: float = 1e-3
    denoiser: str = "unet"
    denoiser_width: int | None = None
    denoiser_depth: int | None = None
    condition_octaves: int | None = None
    dropout: float | None = None
    planner_weight_decay: float | None = None
    first_steps_weight: float | None = None
    precision: str | None = None
    candidates: int | None = None
    channels: tuple[int, ...] | None = None
    schedule: str = "squared_cosine"
    prediction: str = "sample"
    relative: bool | None = None
    relations: bool = True
    controller_state: str = "robot"
    recovery_sigma: float | None = None
    scene_shift: float = 0.05
    scene_turn: float = 0.3
    exchange: bool = True
    solver: str = "dpm++2m"
    solver_steps: int = 10
    planner_from: Path | None = None
    episodes: int | None = None
    threads: int = 1
    device: str = "cpu"
    checkpoint_every: int = 500
    resume: bool = False
    logger: str = "csv"
    analysis: bool = True
    plugins: Plugins = ()

    def __post_init__(self):
        self.out = Path(self.out)  # so that a string will do in Python


@dataclass(frozen=True)
class ResolvedConfig:
    """A :class:`TrainConfig` that leaves nothing open: what planner and controller are trained by.

    Args:
        options (TrainConfig): with the task's defaults where nothing was asked for.
        task (Task): the task.
        method (Method): the method, with the decoder asked for.
        teacher (Method, optional): the method that labels the rest of the data for it.
        released (Released, optional): the settings of the first public code, if they were asked for.
        budget (LabelBudget): which labels may be seen.
        planner (dict): what :func:`~torchrl_koap.training.diffusion_builders.build_planner` takes.
        controller (dict): what :func:`~torchrl_koap.training.builders.build_controller` takes.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training.config import TrainConfig, resolve
        >>> resolved = resolve(TrainConfig(out=Path("runs/koap"), label_fraction=0.05))
        >>> resolved.task.name, resolved.method.name, resolved.budget.amount, resolved.options.steps
        ('avoiding', 'koap', 0.05, 5000)
    """

    options: TrainConfig
    task: Task
    method: Method
    teacher: Method | None
    released: Released | None
    budget: LabelBudget
    planner: dict[str, Any]
    controller: dict[str, Any]

    @property
    def columns(self) -> tuple[int, ...]:
        """State columns that the controller reads."""
        return self.task.controller_columns(self.options.controller_state)

    def controller_view(self, data: TensorDictBase) -> TensorDictBase:
        """Flat data ``[N]`` as the controller sees them: its columns, and actions as distances to their targets."""
        return controller_view(data, self.columns, action_targets=self.task.action_targets)

    def with_labels_of(self, data: TensorDictBase) -> ResolvedConfig:
        """The same with the share of labels that is the default for these data, if none was asked for."""
        if self.options.label_fraction is not None:
            return self
        share = ALL_LABELS if not data["has_action"].all() else LABEL_FRACTION
        options = replace(self.options, label_fraction=share)
        return replace(self, options=options, budget=_budget(options))


def resolve(config: TrainConfig, task: Task | None = None) -> ResolvedConfig:
    """Looks every name up and fills every default in, once; plugins must have been imported.

    Args:
        config (TrainConfig): what is asked for.
        task (Task, optional): the task, registered or not. Default: the one of the data set.

    Raises:
        ValueError: for unknown names, numbers out of range, and options that exclude each other.
        RunDirectoryError: if ``planner_from`` is no finished run.

    Examples:
        >>> from pathlib import Path
        >>> from torchrl_koap.training.config import TrainConfig, resolve
        >>> resolved = resolve(TrainConfig(out=Path("run"), task="avoiding", method="linear"))
        >>> resolved.options.steps, resolved.method.closed_form, resolved.columns
        (5000, True, (0, 1))
    """
    task = find_task_of(config.dataset, config.task) if task is None else task
    options = replace(_with_task_defaults(config, task), task=task.name)
    released = _released(options)
    method = _method(options) if released is None else released.method
    _check(options, method)
    if options.planner_from is not None:
        planner = RunDirectory(options.planner_from).read_entry("config.json", "planner")
    else:
        planner = _planner_entry(options)
    if released is not None and not method.has_planner:
        planner |= POLICY
    controller = {
        "method": options.method,
        "decoder": options.decoder,
        "released": options.released_settings,
        "preset": "released" if options.released_settings else options.preset or method.presets[0],
        "state": options.controller_state if method.has_planner else "all",
    }
    return ResolvedConfig(
        options=options,
        task=task,
        method=method,
        teacher=get_method(method.teacher) if method.teacher else None,
        released=released,
        budget=_budget(options),
        planner=planner,
        controller=controller,
    )


def _with_task_defaults(options: TrainConfig, task: Task) -> TrainConfig:
    defaults = {
        "steps": task.defaults.planner_steps,
        "recovery_sigma": task.defaults.recovery_sigma,
        "episodes": task.defaults.demonstrations,
        "relative": task.defaults.relative,
        "channels": task.defaults.channels,
        "validation_fraction": default_fraction(task),
    }
    return replace(options, **{name: value for name, value in defaults.items() if getattr(options, name) is None})


def _released(options: TrainConfig) -> Released | None:
    if not options.released_settings:
        if options.epochs is not None:
            raise ValueError("epochs are counted with --released-settings only; otherwise there are --controller-steps")
        return None
    if options.decoder is not None or options.preset is not None:
        raise ValueError("released settings come with their own decoder and preset: no --decoder, no --preset")
    if options.epochs is not None and options.epochs < 1:
        raise ValueError(f"epochs must be >= 1, got {options.epochs}")
    return get_released(options.method)


def _method(options: TrainConfig) -> Method:
    method = get_method(options.method, options.decoder)
    if options.preset is not None:
        lookup(PRESETS, options.preset, "preset")
        if options.preset not in method.presets:
            has = list(method.presets)
            raise ValueError(f"method {options.method!r} has no preset {options.preset!r}, it has {has}")
    return method


def _check(options: TrainConfig, method: Method) -> None:
    lookup(("csv", "wandb"), options.logger, "logger")
    if options.logger == "wandb" and importlib.util.find_spec("wandb") is None:
        raise ValueError("--logger wandb needs an extra: pip install 'torchrl_koap[wandb]'")
    if not method.has_planner and options.planner_from is not None:
        raise ValueError(f"method {options.method!r} is a policy of its own and has no planner to take over")
    if options.steps < 1 or options.controller_steps < 0:
        raise ValueError(f"steps must be >= 1, got {options.steps} and {options.controller_steps}")
    if not 0 <= (options.validation_fraction or 0) < 1:
        raise ValueError(f"validation_fraction must be in [0, 1), got {options.validation_fraction}")
    for name in ("batch_size", "controller_batch_size", "checkpoint_every"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name} must be >= 1, got {getattr(options, name)}")


def _budget(options: TrainConfig) -> LabelBudget:
    if options.label_episodes is not None:
        if options.label_count is not None or options.label_unit != "trajectory":
            raise ValueError("label_episodes are trajectories of their own choice: no label_count or label_unit")
        return LabelBudget.of_episodes(options.label_episodes)
    amount = options.label_fraction if options.label_count is None else options.label_count
    amount = LABEL_FRACTION if amount is None else amount
    return LabelBudget(amount, unit=options.label_unit, seed=options.seed, window=WINDOW, history=HISTORY)


def _planner_entry(options: TrainConfig) -> dict[str, Any]:
    sizes = {
        "width": options.denoiser_width,
        "depth": options.denoiser_depth,
        "frequencies": options.condition_octaves,
        "dropout": options.dropout,
    }
    # what was left out is left out here too, so that a run of before can be resumed
    return {name: value for name, value in sizes.items() if value is not None} | {
        "denoiser": options.denoiser,
        "channels": list(options.channels),
        "schedule": options.schedule,
        "prediction": options.prediction,
        "history": HISTORY,
        "horizon": HORIZON,
        "relative": options.relative,
        "relations": options.relations,
        "solver": options.solver,
        "solver_steps": options.solver_steps,
        "clip": 1.2 if options.prediction == "sample" else 1.0,
    }
