# This source code is licensed under the MIT license found in the LICENSE file.
"""The part of a training that needs no labels: the planner."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor

from torchrl_koap.data import (
    ObjectPermutation,
    RandomPlanarTransform,
    RecoveryAugmentation,
    cut_windows,
    extrapolate_ends,
    make_window_buffer,
)
from torchrl_koap.data.recovery import DECAY, GripperRecovery, NeighborRecovery
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.keys import STATE
from torchrl_koap.modules import StatePlanner
from torchrl_koap.modules.planning.energy_score import relative_distance, relative_score, sample_sequences
from torchrl_koap.objectives import PlannerLoss
from torchrl_koap.runs.config import PlannerConfig, TrainConfig
from torchrl_koap.runs.device import DTYPES
from torchrl_koap.tasks import HISTORY, HORIZON, WINDOW, Task
from torchrl_koap.tasks.columns import unit_groups
from torchrl_koap.training.best_weights import BestWeights
from torchrl_koap.training.loop import Phases
from torchrl_koap.training.networks import build_planner

SITUATIONS, SAMPLES = 64, 4  # held-out situations, and plans in each, by which weights are chosen
MOST_WINDOWS = 400_000  # windows for statistics at most; fewer would miss rare steps, which set the scale of plans
RECORDED = 8192  # recorded windows at most in which the nearest one to a plan is searched
CHECKS = 30  # scores per training at most
COST = 0.05  # share of the training time for scores at most
BLIND = 1000  # updates at most if nothing can be held out
SHIFTED = 1 / 30  # s, or a control step if that is longer: the recovery shift is the usual change in this time


def learn_planner(
    task: Task, config: TrainConfig, data: TensorDictBase, loop: Phases, *, held_out: TensorDictBase | None = None
) -> tuple[StatePlanner, dict[str, float]]:
    """Builds and trains a planner on flat data ``[N]`` with the whole ``state``; it does not read actions.

    Held-out trajectories, if any, choose its weights. Returns the planner, with averaged parameters, and its last
    losses.

    Warns:
        UserWarning: if trajectories are to be held out and there is only one.
    """
    section = config.planner
    if section.held_out and held_out is None:
        section = replace(section, steps=min(section.steps, BLIND))
        warnings.warn(
            f"one trajectory is too few to hold any out (planner.held_out {section.held_out:g}): the planner trains for"
            f" {section.steps} updates, and overfitting cannot be detected",
            stacklevel=2,
        )
    planner = build_planner(task, section).to(config.run.device)
    # windows hold two observed frames even for a planner that reads one: augmentations find the present frame by them
    unseen = HISTORY - planner.history
    extended, windows = planned_windows(data)
    planner.fit_normalizers(windows[:, unseen:])
    augment = augmentation(task, windows)
    score = None if held_out is None else plan_score(planner, held_out, spread_evenly(windows, RECORDED), task)
    del windows  # may be larger than the data
    buffer = make_window_buffer(extended, WINDOW, section.batch_size, select=[STATE], pad_before=1)

    weights = column_weights(task)
    loss = PlannerLoss(planner, dtype=DTYPES[config.run.precision], weights=weights).to(config.run.device)
    best = None if score is None else BestWeights(loss, score, check_interval(section, planner.num_steps))
    values = loop.denoise("planner", loss, lambda: augment(buffer.sample())[:, unseen:], section, best=best)
    loss.target_network_params.to_module(planner)
    if best is not None:
        planner.load_state_dict(best.network.state_dict())
        values["held_out_seconds"] = best.seconds.item()
    return planner, values


def planned_windows(data: TensorDictBase) -> tuple[TensorDictBase, Tensor]:
    """Extrapolates trajectories of flat data ``[N]`` beyond their ends; returns them and state windows ``[M, T, d]``.

    A plan made near the end of a demonstration needs a future, one made at its start a repeated first frame.
    """
    extended = extrapolate_ends(data, HORIZON - 1)
    return extended, cut_windows(extended, WINDOW, select=[STATE], pad_before=1, most=MOST_WINDOWS)[STATE]


def column_weights(task: Task) -> Tensor | None:
    """Returns weights ``[d]`` of state columns in a planner's loss: the executed ones of the robot have 1/3 of the sum.

    None, all columns alike, if the robot has no column, or a share of 1/3 or more.
    """
    columns, robot = task.state_dim, len(task.robot)
    if not 0 < 3 * robot < columns:
        return None
    weights = torch.full([columns], 2 / (columns - robot))
    weights[list(task.robot)] = 1 / robot
    return weights


def check_interval(section: PlannerConfig, solver_steps: int) -> int:
    """Returns the number of updates between two scores for which scores take 5 % of the time.

    An update costs three bfloat16 forward passes, about one in float32; a plan costs ``solver_steps`` of the latter.
    """
    updates = SITUATIONS * SAMPLES * solver_steps / section.batch_size
    return min(max(section.steps // CHECKS, math.ceil(updates / COST)), section.steps)


def plan_score(
    planner: StatePlanner, data: TensorDictBase, recorded: Tensor, task: Task
) -> Callable[[StatePlanner], float]:
    """Makes a function that scores planners on held-out trajectories; smaller is better.

    The score is the energy score of plans, relative to that of standing still, times the squared distance of plans from
    recordings (:func:`relative_distance`). The energy score alone is best long before rollouts are: it rewards plans
    that spread, but only one of them is executed. The product ranks planners nearly as rollouts do on Push-T and
    Avoiding, less so on Meta-World, and not on Adroit's door (``benchmarks/planner_scores.py``).

    Flat data ``[N]`` have ``state``; ``recorded`` are windows ``[M, T, d]`` that end with the planner's horizon. Scored
    planners have the history and horizon of the given one.
    """
    length = planner.history + planner.horizon
    past = planner.history - 1
    states = cut_windows(data, length, select=[STATE], pad_before=past, most=SITUATIONS)[STATE]
    history, future = planner.split_window(states)
    still, groups = history[:, -1:].expand_as(future), list(unit_groups(task.state_units).values())
    known = recorded[:, -planner.horizon :].to(future)

    def score(planner: StatePlanner) -> float:
        plans = sample_sequences(planner, history, samples=SAMPLES)
        return relative_score(plans, future, still, groups) * relative_distance(plans, future, known, groups) ** 2

    return score


def augmentation(task: Task, windows: Tensor, *, actions: bool = False) -> TensorDictSequential:
    """Makes the augmentations of training windows for a planner, or for a network that samples actions.

    ``windows`` are raw states ``[N, T, d]``. With ``actions``, actions must fit the augmented states: scenes are then
    moved, and the robot displaced, only if every action names the state column that it moves.
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
        steps_shifted = max(SHIFTED * task.control_hz, 1.0)
        sigma: float | Tensor | None = task.defaults.recovery
        if sigma is None:  # the usual change of a column
            sigma = steps_shifted * (windows[:, 1] - windows[:, 0]).square().mean(0).sqrt()
        if task.tool_columns is not None:
            sizes = torch.as_tensor(sigma).expand(task.state_dim).clone()
            sizes[arm] = task.defaults.joint_recovery
            sigma = sizes
        steps.append(
            RecoveryAugmentation(
                sigma,
                history=HISTORY,
                decay=DECAY ** (1 / steps_shifted),
                under_way=task.env is None,
                columns=arm,
                tool=task.tool_columns,
                kinematics=task.tool_position,
                moved_by=moved_by,
            )
        )
    if task.gripper is not None and not actions:
        steps.append(GripperRecovery(task.gripper[1], history=HISTORY))
    if task.defaults.neighbor_recovery and not actions:
        steps.append(NeighborRecovery(task.defaults.neighbor_recovery, history=HISTORY))
    return TensorDictSequential(*steps)
