# This source code is licensed under the MIT license found in the LICENSE file.
"""The part of a training that needs no labels: the planner."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential

from torchrl_koap.data import (
    GripperRecovery,
    NeighborRecovery,
    ObjectPermutation,
    RandomPlanarTransform,
    RecoveryAugmentation,
    cut_windows,
    extrapolate_ends,
    make_window_buffer,
)
from torchrl_koap.modules import StatePlanner
from torchrl_koap.objectives import PlannerLoss
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.device import training_dtype
from torchrl_koap.runs.progress import progress_bar, show_losses
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import load_weights, save_weights
from torchrl_koap.tasks import HISTORY, Task
from torchrl_koap.training.diffusion_builders import build_planner
from torchrl_koap.training.loop import moving_average, phase_finished, train_phase
from torchrl_koap.training.resolved import ResolvedConfig

WEIGHT_DECAY = 1e-4  # of a planner, or of a policy of its own


def train_planner(
    run: RunDirectory, resolved: ResolvedConfig, data: TensorDictBase, logger: Any = None
) -> tuple[StatePlanner, dict[str, float]]:
    """Trains the planner, takes it over from another run, or loads it where that is done.

    Args:
        run (RunDirectory): where weights, metrics and checkpoints go.
        resolved (ResolvedConfig): all options.
        data (TensorDictBase): flat data with the whole ``state``; no action is looked at.
        logger (optional): a TorchRL logger.

    Returns:
        tuple: the planner and its last losses.
    """
    options, task = resolved.options, resolved.task
    planner = build_planner(resolved.planner, data["state"].shape[-1], task.planner_features()).to(options.device)
    source = run.path if options.planner_from is None else Path(options.planner_from)
    if options.planner_from is not None or (options.resume and phase_finished(run, "planner")):
        load_weights(source / "planner.safetensors", planner, task=task.name)
        if options.planner_from is not None:
            save_weights(run.path / "planner.safetensors", planner, {"task": task.name, "kind": "planner"})
        return planner, run.last_metrics("planner")
    values = learn_states(planner, data, task, options, run=run, logger=logger)
    save_weights(run.path / "planner.safetensors", planner, {"task": task.name, "kind": "planner"})
    return planner, values


def learn_states(
    planner: StatePlanner,
    data: TensorDictBase,
    task: Task,
    options: TrainConfig,
    *,
    run: RunDirectory | None = None,
    logger: Any = None,
) -> dict[str, float]:
    """Fits a planner's statistics and trains it; it is left with the average of its parameters.

    Args:
        planner (StatePlanner): the planner; it is trained in place.
        data (TensorDictBase): flat data with the whole ``state``; no action is looked at.
        task (Task): whose data they are.
        options (TrainConfig): updates, batch size, learning rate, augmentation, with the task's defaults filled in.

    Keyword Args:
        run (RunDirectory, optional): where metrics and checkpoints go. Default: nowhere.
        logger (optional): a TorchRL logger.

    Returns:
        dict: its last losses.
    """
    # a plan made near the end of a demonstration needs a future, one made at its start a repeated first frame
    # windows hold two observed frames, which tell augmentations the present one, also for a planner that sees only one
    length, unseen = HISTORY + planner.horizon, HISTORY - planner.history
    extended = extrapolate_ends(data, planner.horizon - 1)
    windows = cut_windows(extended, length, select=["state", "episode"], pad_before=1)
    augment = augmentation(task)
    states, groups = windows["state"][:, unseen:], windows["episode"][:, -1]
    seen = None if planner.forecast is None else augment(windows.clone())["state"][:, unseen:]
    planner.fit_normalizers(states, seen=seen, groups=groups)
    planner.to(options.device)
    buffer = make_window_buffer(extended, length, options.batch_size, select=["state"], pad_before=1)

    def draw() -> TensorDictBase:
        return augment(buffer.sample())[:, unseen:]

    loss = PlannerLoss(planner, dtype=training_dtype(options.precision, options.device))
    with progress_bar(options.steps, "planner", smoothing=0.05, mininterval=0.5) as bar:
        values = train_phase(
            "planner",
            loss,
            draw,
            num_steps=options.steps,
            learning_rate=options.planner_learning_rate,
            weight_decay=WEIGHT_DECAY,
            target_update=moving_average(loss, options.steps),
            run=run,
            logger=logger,
            checkpoint_every=options.checkpoint_every,
            resume=options.resume,
            progress=show_losses(bar),
        )
    loss.target_network_params.to_module(planner)
    return values


def augmentation(task: Task, *, actions: bool = False) -> TensorDictSequential:
    """What windows undergo before the planner, or a policy of its own, learns from them.

    Args:
        task (Task): the task of the windows.

    Keyword Args:
        actions (bool): the windows hold actions, which have to fit the states afterwards. Scenes are then moved, and
            the robot displaced, only where every action names the state column that it moves.
    """
    moved_by = list(task.moved_columns()) if actions else None
    steps = []
    if task.interchangeable_columns():
        steps.append(ObjectPermutation(task.interchangeable_columns()))
    if task.planar_parts and (moved_by or not actions):
        points, directions = task.planar_columns()
        turned = None if moved_by is None else [moved_by.index(column) for column in points[0]]
        steps.append(RandomPlanarTransform(points, directions, history=HISTORY, turned_actions=turned))
    if moved_by or not actions:
        arm = [column for column in task.robot if task.gripper is None or column != task.gripper[1]]
        tool: dict[str, Any] = {"tool": task.tool_columns, "kinematics": task.tool_position}
        sigma = task.defaults.recovery_sigma
        steps.append(RecoveryAugmentation(sigma, history=HISTORY, columns=arm, moved_by=moved_by, **tool))
    if task.gripper is not None and not actions:
        steps.append(GripperRecovery(task.gripper[1], history=HISTORY))
    neighbor = task.defaults.view.get("neighbor_recovery")
    if neighbor and not actions:
        steps.append(NeighborRecovery(neighbor, history=HISTORY))
    return TensorDictSequential(*steps)
