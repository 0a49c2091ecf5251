# This source code is licensed under the MIT license found in the LICENSE file.
"""Meaning of action columns, and rules that turn decoded numbers into actions: absolute targets and grippers.

D3IL's data hold no gripper command: their action is the next measured width, and the environment opens above 0.075 m.
While the fingers open, the next widths are below that and mean "close", so a policy that sends them never opens. The
gripper command is therefore 0.08 m while the fingers are opening, and the next width otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from torch import Tensor

OPEN_ABOVE = 0.075  # m; a greater gripper command opens the fingers, any other closes them
PLANNED_OPEN_ABOVE = 0.07  # m; half way between holding a box and open: plans err by some millimetres
OPEN = 0.08  # m; distance of open fingers
OPENING = 5  # control steps that the fingers need to open
_MOVES = 1e-4  # m; larger increases of the width are movement
ActionKind = Literal["delta", "absolute", "raw", "gripper"]


@dataclass(frozen=True)
class Action:
    """Meaning of one action column.

    Args:
        unit (str): such as ``"m"``, ``"rad"``, ``"N"`` or ``""``; errors are averaged over columns of one unit.
        kind (str): ``"delta"``: a change of a command or a velocity, small when the robot stands still;
            ``"absolute"``: the command itself; ``"gripper"``: an absolute command computed from planned widths;
            ``"raw"``: anything else, such as a torque or a normalised target; nothing is assumed about it.
        column (int, optional): state column that a ``"delta"`` moves, that is the target of an ``"absolute"`` action
            (controllers then decode the distance to it), or that holds the width of a ``"gripper"``.
    """

    unit: str = ""
    kind: ActionKind = "delta"
    column: int | None = None


@dataclass(frozen=True)
class ActionRule:
    """Turns decoded actions into those that the robot takes."""

    # action column and state column of a gripper whose command follows from its widths (:func:`gripper_command`)
    gripper: tuple[int, int] | None = None
    # action column and state column of each action that the controller decodes as a distance from the state
    distances: Sequence[tuple[int, int]] = ()
    constants: Mapping[int, float] = field(default_factory=dict)  # numbers that all labels repeat, by action column

    def __call__(self, states: Tensor, actions: Tensor) -> Tensor:
        """Returns the actions ``[*B, T, act]`` in states ``[*B, T, d]``."""
        actions = shift_actions(actions, states, self.distances)
        for entry, value in self.constants.items():
            actions[..., entry] = value
        if self.gripper is not None:  # the last frame has no next width and stays as decoded
            entry, column = self.gripper
            actions[..., :-1, entry] = gripper_command(states[..., column], open_above=PLANNED_OPEN_ABOVE)
        return actions


def shift_actions(actions: Tensor, states: Tensor, distances: Sequence[tuple[int, int]], sign: int = 1) -> Tensor:
    """Adds states ``[*B, d]`` to actions ``[*B, act]`` that are distances from them; ``sign`` -1 subtracts them."""
    moved = actions.clone()
    for entry, column in distances:
        moved[..., entry] = moved[..., entry] + sign * states[..., column]
    return moved


def gripper_command(width: Tensor, *, open_above: float = OPEN_ABOVE) -> Tensor:
    """Computes gripper commands ``[*B, T - 1]`` from widths ``[*B, T]`` (m), which are open above ``open_above``."""
    now, following = width[..., :-1], width[..., 1:]
    padded = torch.cat([following, width[..., -1:].expand(*width.shape[:-1], OPENING - 1)], -1)
    soon = padded.unfold(-1, OPENING, 1).amax(-1)
    opening = (following > now + _MOVES) & (soon > open_above)
    return torch.where(opening | (following > open_above), following.clamp_min(OPEN), following)
