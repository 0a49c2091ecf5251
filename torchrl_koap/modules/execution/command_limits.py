# This source code is licensed under the MIT license found in the LICENSE file.
"""How fast a robot is told to be, and how far its command may be ahead of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn


class CommandLimits(nn.Module):
    r"""Multiplies changes of a command, and holds back those that would take it too far ahead of the robot.

    .. math::
        a' = \operatorname{clip}(c + g a - x,\; -l,\; l) - (c - x)

    with the last command ``c``, the measured position ``x``, an action ``a`` that changes the command, the gain ``g``
    and the lead ``l``. Where a robot is blocked, at the end of its reach or by what it pushes against, every plan that
    leads on adds to the command, which nothing takes back (integrator windup): the command ends metres away, and what
    is decided from then on hardly moves the robot. With a limit it answers as soon as plans turn back.

    Args:
        actions (sequence of int): action columns that change the command.

    Keyword Args:
        gain (float): ``g``.
        lead (float, optional): ``l``, in the units of the actions; 0 sets no limit.
        commands (sequence of int): observation columns that repeat the last command; needed for a lead.
        positions (sequence of int): state columns of what each of them moves; likewise.
        state_of (callable, optional): from observations ``[*B, obs]`` to states ``[*B, d]``. Default: they are the
            same.

    Raises:
        ValueError: if no action is a change of a command, for a gain or lead out of range, or columns that differ in
            number.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import CommandLimits
        >>> limits = CommandLimits([0, 1], lead=0.1, commands=[0, 1], positions=[2, 3])
        >>> ahead = torch.tensor([[0.59, 0.2, 0.5, 0.2]])  # commanded and measured xy (m)
        >>> limits(ahead, torch.full([2], 0.02))
        tensor([0.0100, 0.0200])
    """

    def __init__(
        self,
        actions: Sequence[int],
        *,
        gain: float = 1.0,
        lead: float = 0.0,
        commands: Sequence[int] = (),
        positions: Sequence[int] = (),
        state_of: Callable[[Tensor], Tensor] | None = None,
    ):
        super().__init__()
        if not len(actions):
            raise ValueError(f"gain {gain:g} and lead {lead:g} were given, but no action is a change of a command")
        if not 0 < gain < math.inf or not 0 <= lead < math.inf:
            raise ValueError(f"gain must be a number above 0 and lead one of at least 0, got {gain} and {lead}")
        if lead and not (commands or positions):
            raise ValueError(f"lead {lead:g} was given, but the observation repeats no command that actions change")
        if lead and not len(commands) == len(positions) == len(actions):
            raise ValueError(
                "as many commands, positions and actions are needed, got"
                f" {len(commands)}, {len(positions)} and {len(actions)} columns"
            )
        self.gain, self.lead, self.state_of = gain, lead, state_of
        for name, columns in {"actions": actions, "commands": commands, "positions": positions}.items():
            self.register_buffer(name, torch.as_tensor(list(columns), dtype=torch.long), persistent=False)

    def forward(self, observations: Tensor, action: Tensor) -> Tensor:
        """What is left of an action.

        Args:
            observations (Tensor): ``[*B, history, obs]``, the present one last.
            action (Tensor): ``[*B, act]``; not changed.

        Returns:
            Tensor: ``[*B, act]``; what is within the limits keeps its bits, for episodes with contacts turn out
            otherwise for a rounding error.
        """
        if self.gain != 1:
            factors = torch.ones(action.shape[-1], dtype=action.dtype, device=action.device)
            action = action * factors.index_fill(0, self.actions, self.gain)
        if not self.lead:
            return action
        frame, action = observations[..., -1, :], action.clone()
        state = frame if self.state_of is None else self.state_of(frame)
        ahead = (frame[..., self.commands] - state[..., self.positions]).to(action.dtype)
        wanted = action[..., self.actions]
        reach = ahead + wanted
        held = reach.clamp(-self.lead, self.lead)
        action[..., self.actions] = torch.where(held == reach, wanted, held - ahead)
        return action
