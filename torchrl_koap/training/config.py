# This source code is licensed under the MIT license found in the LICENSE file.
"""What a training is asked to do, and the same with every default filled in and every name looked up."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, controller_view
from torchrl_koap.data.label_budget import Unit
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS
from torchrl_koap.tasks import HISTORY, HORIZON, WINDOW, Task
from torchrl_koap.training.datasets import find_task_of
from torchrl_koap.training.loggers import check_logger
from torchrl_koap.training.methods import COEFFICIENTS, Method, get_method, loss_coefficients
from torchrl_koap.training.plugins import Plugins
from torchrl_koap.training.released_settings import POLICY, Released, get_released
from torchrl_koap.training.response import tracked_columns
from torchrl_koap.training.run_directory import RunDirectory
from torchrl_koap.training.validation import default_fraction

# defaults for data that lack labels or came without an environment, and for all others
ALL_LABELS, LABEL_FRACTION = 1.0, 0.02


@dataclass
class TrainConfig:
    """Train planner and controller on demonstrations of which few have action labels.

    Attributes:
        out: run directory to write.
        task: name of the task (default: that of the data set, if it says so; else "avoiding").
        dataset: "scripted", or a folder: written by `koap demos`, `koap convert` or save_demonstrations, of D3IL raw
            pickles, or a LeRobot data set.
        label_fraction: share of the trajectories, windows or transitions that keep their actions (default: 0.02; all
            labels that there are, where data lack some or the task has no environment).
        label_count: number of them instead of a share.
        label_episodes: these trajectories instead of a random choice, as `koap suggest` names them.
        label_unit: "trajectory", "window" (the unit of the first public code) or "transition".
        seed: seed of label choice, initialisation and batches.
        observation_fraction: share of the trajectories that are used at all; those with labels come first.
        validation_fraction: share of the trajectories that the planner never sees, those without labels first, for
            `koap eval` to judge its plans by (default: 0.1 for a task without an environment, else none).
        method: "koap", "koap_mpc" (plans followed by prediction), "linear" (ridge on raw frames), "dd" (supervised
            inverse dynamics), "dp" (Diffusion Policy), or another name in torchrl_koap.training.methods.METHODS, those
            that plugins register included (default: that of the task; "koap" with --released-settings).
        released_settings: the unequal network, learning rate and updates that the first public code has for the method.
        epochs: with released settings, epochs instead of the first code's.
        preset: variant of KOAP: "default", "semi_supervised", "paper" or "released" (default: the method's own).
        koopman_coeff: weight of the Koopman term in the loss, for methods that have one (default: 1).
        action_coeff: weight of the action term, for methods whose action decoder is trained with the rest (default: 1).
        decoder: "ridge" (closed form on frozen latent actions) or "sgd" (trained with the rest); default: the method's.
        steps: planner updates (default: that of the task); a number below controller_steps shortens that too.
        controller_steps: controller updates.
        batch_size: windows per planner update (default: 128, or the task's).
        controller_batch_size: windows per controller update.
        planner_learning_rate: peak learning rate of the planner (default: 3e-3, or the task's).
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
        forecast: plan deviations from a linear forecast, which carries over to goals not demonstrated (default: for a
            task without an environment).
        frame: object from which the planner sees everything, such as "target": tasks whose place on the table does not
            matter (default: the world).
        plan_steps: frames of the plan that are modelled, counted from 1, such as 1 2 3 4 6 8 11 14; those in between
            lie on straight lines, and the last one is the horizon (default: all of 14).
        observed_frames: frames that the planner sees, 1 or 2 (default: 2).
        relations: tell the planner where the tool is as seen from the objects (tasks with objects).
        controller_state: what the controller reads, "robot" (the robot's own columns) or "all" (KOAP's configurations).
        recovery_sigma: typical shift of the recovery augmentation in m or rad (default: the task's); 0 turns it off.
        recovery_response: how the augmentation leads back, "first_order" at once or "second_order" from rest, which
            robots that follow their commands late can do (default: the task's).
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
        force_data: resume although the demonstrations, or the version of this package, are others than at the start.
        logger: "csv" (metrics.csv alone), or as well "wandb" (offline unless WANDB_MODE says otherwise), "tensorboard"
            or "mlflow" (in the run directory unless MLFLOW_TRACKING_URI says otherwise).
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
    method: str | None = None
    released_settings: bool = False
    epochs: int | None = None
    preset: str | None = None
    koopman_coeff: float | None = None
    action_coeff: float | None = None
    decoder: str | None = None
    steps: int | None = None
    controller_steps: int = 500
    batch_size: int | None = None
    controller_batch_size: int = 256
    planner_learning_rate: float | None = None
    controller_learning_rate: float = 1e-3
    denoiser: str | None = None
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
    forecast: bool | None = None
    frame: str | None = None
    plan_steps: tuple[int, ...] | None = None
    observed_frames: int | None = None
    relations: bool = True
    controller_state: str = "robot"
    recovery_sigma: float | None = None
    recovery_response: str | None = None
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
    force_data: bool = False
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
        every = self.task.env is None or not data["has_action"].all()
        share = ALL_LABELS if every else LABEL_FRACTION
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
    if not method.has_planner:
        if config.forecast:
            raise ValueError(f"method {options.method!r} is a policy of its own and has no plans to forecast")
        options = replace(options, forecast=None)
    if options.planner_from is not None:
        planner = RunDirectory(options.planner_from).read_entry("config.json", "planner")
    else:
        planner = _planner_entry(options, task)
    if released is not None and not method.has_planner:
        planner |= POLICY
    preset = "released" if options.released_settings else options.preset or method.presets[0]
    controller: dict[str, Any] = {
        "method": options.method,
        "decoder": options.decoder,
        "released": options.released_settings,
        "preset": preset,
        "state": options.controller_state if method.has_planner else "all",
    }
    if "lifting" in PRESETS[preset]:
        controller["lifting"] = PRESETS[preset]["lifting"]
    if method.earlier:
        controller["revised"] = True
    if method.tracks:
        controller["tracking"] = tracked_columns(task)
    if len(task.absolute_actions) == task.action_dim and not task.action_targets:
        controller["absolute"] = True
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


_UNET = {"denoiser": "unet", "batch_size": 128, "planner_learning_rate": 3e-3}


def _with_task_defaults(options: TrainConfig, task: Task) -> TrainConfig:
    # a network that is asked for by name, or that of the first public code, comes with its own sizes
    own = task.defaults.planner if options.denoiser is None and not options.released_settings else {}
    defaults: dict[str, Any] = (
        _UNET
        | dict(own)
        | {
            "method": "koap" if options.released_settings else task.defaults.method,
            "steps": task.defaults.planner_steps,
            "recovery_sigma": task.defaults.recovery_sigma,
            "recovery_response": task.defaults.recovery_response,
            "episodes": task.defaults.demonstrations,
            "relative": task.defaults.relative,
            "channels": task.defaults.channels,
            "validation_fraction": default_fraction(task),
            "forecast": True if task.env is None and not options.released_settings else None,
        }
    )
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


_LEAST = (
    dict.fromkeys(("batch_size", "controller_batch_size", "checkpoint_every", "candidates"), 1)
    | dict.fromkeys(("denoiser_width", "denoiser_depth"), 1)
    | dict.fromkeys(("condition_octaves", "dropout", "planner_weight_decay", "first_steps_weight"), 0)
    | dict.fromkeys(("recovery_sigma", "scene_shift", "scene_turn"), 0)
)


def _check(options: TrainConfig, method: Method) -> None:
    check_logger(options.logger)
    for name in COEFFICIENTS:
        value = getattr(options, name)
        if value is not None and name not in loss_coefficients(method):
            raise ValueError(f"{name} was given, but no loss of method {options.method!r} has it")
        if value is not None and value < 0:
            raise ValueError(f"{name} must be >= 0, got {value}")
    if not method.has_planner and options.planner_from is not None:
        raise ValueError(f"method {options.method!r} is a policy of its own and has no planner to take over")
    for name in ("frame", "plan_steps", "observed_frames"):
        if getattr(options, name) is not None and not method.has_planner:
            raise ValueError(f"{name} is the planner's, which method {options.method!r} does not have")
    if options.observed_frames not in (None, *range(1, HISTORY + 1)):
        raise ValueError(f"observed_frames must be 1 to {HISTORY}, got {options.observed_frames}")
    if options.plan_steps is not None and (not options.plan_steps or options.plan_steps[-1] < 4):
        raise ValueError(f"plan_steps must end at 4 or more control steps, got {list(options.plan_steps)}")
    if options.steps < 1 or options.controller_steps < 0:
        raise ValueError(f"steps must be >= 1, got {options.steps} and {options.controller_steps}")
    for name in ("planner_learning_rate", "controller_learning_rate"):
        if not 0 < getattr(options, name) < math.inf:
            raise ValueError(f"{name} must be a number above 0, got {getattr(options, name)}")
    if options.label_fraction is not None and not 0 < options.label_fraction <= 1:
        raise ValueError(f"label_fraction: a fraction must be in (0, 1], got {options.label_fraction}")
    lookup(("float32", "bfloat16"), options.precision or "float32", "precision")
    if options.seed < 0:
        raise ValueError(f"seed must be >= 0, got {options.seed}")
    if not 0 <= (options.validation_fraction or 0) < 1:
        raise ValueError(f"validation_fraction must be in [0, 1), got {options.validation_fraction}")
    for name, least in _LEAST.items():
        value = getattr(options, name)
        if value is not None and value < least:
            raise ValueError(f"{name} must be >= {least}, got {value}")
    if options.dropout is not None and options.dropout >= 1:
        raise ValueError(f"dropout must be in [0, 1), got {options.dropout}")
    if not 0 < options.observation_fraction <= 1:
        raise ValueError(f"observation_fraction: a fraction must be in (0, 1], got {options.observation_fraction}")


def _budget(options: TrainConfig) -> LabelBudget:
    if options.label_episodes is not None:
        if options.label_count is not None or options.label_unit != "trajectory":
            raise ValueError("label_episodes are trajectories of their own choice: no label_count or label_unit")
        return LabelBudget.of_episodes(options.label_episodes)
    amount = options.label_fraction if options.label_count is None else options.label_count
    amount = LABEL_FRACTION if amount is None else amount
    unit = cast("Unit", options.label_unit)  # another one is refused there
    return LabelBudget(amount, unit=unit, seed=options.seed, window=WINDOW, history=HISTORY)


def _frame_of(task: Task, name: str) -> dict[str, list]:
    """Columns of the frame of an object (:class:`~torchrl_koap.modules.diffusion.planar_frame.PlanarFrame`)."""
    ends = ("_position", "_quaternion")
    parts = [part.removesuffix(ends[0]) for part in task.planar_parts if part.endswith(ends[0])]
    bodies = [body for body in parts if body + ends[1] in task.planar_parts]
    if not bodies:
        raise ValueError(f"frame was given, but in task {task.name!r} the place on the table matters")
    lookup(bodies, name, "frame")
    points, directions = task.planar_columns()
    place, yaw = (task.state_slices[name + end].start for end in ends)
    return {
        "points": [list(pair) for pair in points],
        "directions": [list(pair) for pair in directions],
        "origin": [place, place + 1],
        "heading": [yaw, yaw + 1],
    }


def _planner_entry(options: TrainConfig, task: Task) -> dict[str, Any]:
    sizes = {
        "width": options.denoiser_width,
        "depth": options.denoiser_depth,
        "frequencies": options.condition_octaves,
        "dropout": options.dropout,
        "forecast": options.forecast or None,
        "frame": None if options.frame is None else _frame_of(task, options.frame),
        "plan_steps": None if options.plan_steps is None else list(options.plan_steps),
    }
    # what was left out is left out here too, so that a run of before can be resumed
    return {name: value for name, value in sizes.items() if value is not None} | {
        "denoiser": options.denoiser,
        "channels": list(options.channels),
        "schedule": options.schedule,
        "prediction": options.prediction,
        "history": options.observed_frames or HISTORY,
        "horizon": options.plan_steps[-1] if options.plan_steps else HORIZON,
        "relative": options.relative,
        "relations": options.relations,
        "solver": options.solver,
        "solver_steps": options.solver_steps,
        "clip": 1.2 if options.prediction == "sample" else 1.0,
    }
