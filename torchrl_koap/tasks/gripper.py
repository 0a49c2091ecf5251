# This source code is licensed under the MIT license found in the LICENSE file.
"""The gripper's number, read off the widths that follow: recorded ones make labels of it, planned ones commands.

D3IL's data hold no gripper command: their action is the next measured width, and the environment opens above 0.075 m.
While the fingers open, the next widths are numbers that mean "close" when sent, so a policy that sends them never
opens. Here the number is 0.08 m as long as the fingers are on the way to open, and the next width otherwise.
"""

from __future__ import annotations

import torch
from torch import Tensor

OPEN_ABOVE = 0.075  # m; greater numbers open
PLANNED_OPEN_ABOVE = 0.07  # m; half way from a box held to fingers open: plans err by some millimetres
OPEN = 0.08
OPENING = 5  # control steps that the fingers need to open
_MOVES = 1e-4


def gripper_number(width: Tensor, *, open_above: float = OPEN_ABOVE) -> Tensor:
    """Numbers for all steps but the last of a sequence of widths.

    Args:
        width (Tensor): ``[*B, T]`` (m).

    Keyword Args:
        open_above (float): widths above it count as open (m).

    Returns:
        Tensor: ``[*B, T - 1]`` (m): above 0.075 opens, anything else closes.

    Examples:
        >>> import torch
        >>> from torchrl_koap.tasks.gripper import gripper_number
        >>> gripper_number(torch.tensor([0.0, 0.03, 0.06, 0.08, 0.08, 0.07, 0.06, 0.06]))
        tensor([0.0800, 0.0800, 0.0800, 0.0800, 0.0700, 0.0600, 0.0600])
    """
    now, following = width[..., :-1], width[..., 1:]
    padded = torch.cat([following, width[..., -1:].expand(*width.shape[:-1], OPENING - 1)], -1)
    soon = padded.unfold(-1, OPENING, 1).amax(-1)
    opening = (following > now + _MOVES) & (soon > open_above)
    return torch.where(opening | (following > open_above), following.clamp_min(OPEN), following)


def command_gripper(states: Tensor, actions: Tensor, *, entry: int, column: int) -> Tensor:
    """Actions whose gripper entry is the number read off the widths that are planned.

    Args:
        states (Tensor): observed and planned states ``[*B, T, d]``.
        actions (Tensor): actions of the same frames ``[*B, T, act]``; not changed.

    Keyword Args:
        entry (int): the gripper's entry of an action.
        column (int): the state column of its width (m).

    Returns:
        Tensor: ``[*B, T, act]``; the last frame, which nothing follows, stays as it is.

    Examples:
        >>> import torch
        >>> from torchrl_koap.tasks.gripper import command_gripper
        >>> widths = torch.tensor([[0.0], [0.05], [0.08]])
        >>> command_gripper(widths, torch.zeros(3, 2), entry=1, column=0)[:, 1]
        tensor([0.0800, 0.0800, 0.0000])
    """
    actions = actions.clone()
    actions[..., :-1, entry] = gripper_number(states[..., column], open_above=PLANNED_OPEN_ABOVE)
    return actions
