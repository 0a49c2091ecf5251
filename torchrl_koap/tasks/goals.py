# This source code is licensed under the MIT license found in the LICENSE file.
"""Whether a *state*, planned or recorded, is one in which the task is done: the success rules of spec section 6.

Environments judge the physics; these functions judge states as planner and controller see them, so that a plan can be
judged without executing it. Tolerances are the environments' own, heights apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import Task

FINISH_Y = 0.35
# horizontal part of 18 mm when tray and target centres differ by 9.1 mm in height
ALIGNED_DISTANCE, ALIGNED_ROTATION = 0.0155, 0.048 * math.pi
BINS = {"red": (0.3, 0.5), "blue": (0.525, 0.725)}
BIN_Y = (0.22, 0.41)
ZONE, ZONE_RADIUS, LEAST_STEP = (0.5, 0.2), 0.06, 0.03


def _avoiding(task: Task, state: Tensor) -> Tensor:
    return state[..., 1] > FINISH_Y


def _aligning(task: Task, state: Tensor) -> Tensor:
    part = {name: state[..., columns] for name, columns in task.state_slices.items()}
    distance = (part["box_position"] - part["target_position"]).norm(dim=-1)
    cosine = torch.nn.functional.cosine_similarity(part["box_quaternion"], part["target_quaternion"], dim=-1)
    return (distance <= ALIGNED_DISTANCE) & (cosine >= math.cos(ALIGNED_ROTATION))


def _sorting(task: Task, state: Tensor) -> Tensor:
    done = torch.ones(state.shape[:-1], dtype=torch.bool, device=state.device)
    for box in task.objects:
        x, y = state[..., task.state_slices[f"{box}_xy"]].unbind(-1)
        low, high = BINS[box.partition("_")[0]]
        done &= (x > low) & (x < high) & (y > BIN_Y[0]) & (y < BIN_Y[1])
    return done


def _stacked(task: Task, state: Tensor) -> Tensor:
    boxes = torch.stack([state[..., task.state_slices[f"{box}_position"]] for box in task.objects], -2)
    near = (boxes[..., :2] - boxes.new_tensor(ZONE)).norm(dim=-1) <= ZONE_RADIUS
    if task.name == "stacking_1":
        return near.any(-1)
    height = boxes[..., 2].sort(-1).values
    return near.all(-1) & (height.diff(dim=-1).amin(-1) > LEAST_STEP)


GOALS: dict[str, Callable[[Task, Tensor], Tensor]] = {
    "avoiding": _avoiding,
    "aligning": _aligning,
    "sorting": _sorting,
    "sorting_2": _sorting,
    "sorting_6": _sorting,
    "po_sorting": _sorting,
    "stacking": _stacked,
    "stacking_1": _stacked,
}


def goal_reached(task: Task, state: Tensor) -> Tensor:
    """Which states are ones in which the task is done.

    Args:
        task (Task): the task.
        state (Tensor): ``[*B, d]``, see :meth:`~torchrl_koap.tasks.Task.state_of`.

    Returns:
        Tensor: bool ``[*B]``.

    Raises:
        ValueError: if no goal is known for the task, or the state has another number of columns.

    Examples:
        >>> import torch
        >>> from torchrl_koap.tasks.goals import goal_reached
        >>> from torchrl_koap.tasks import get_task
        >>> goal_reached(get_task("avoiding"), torch.tensor([[0.5, 0.36], [0.5, 0.2]]))
        tensor([ True, False])
    """
    rule = lookup(GOALS, task.name, "task with a goal")
    if state.shape[-1] != task.state_dim:
        raise ValueError(f"a state of task {task.name!r} has {task.state_dim} columns, got {state.shape[-1]}")
    return rule(task, state)
