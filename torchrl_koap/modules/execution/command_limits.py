# This source code is licensed under the MIT license found in the LICENSE file.
"""Limits, gain and lead of commands (:class:`Execution`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

Ranges = Sequence[Sequence[float] | None]  # least and greatest number of every column


def ends_of(ranges: Ranges) -> Tensor:
    """Least and greatest number of every column ``[act, 2]``, infinite where there is no range."""
    return torch.tensor([(-math.inf, math.inf) if r is None else r for r in ranges])


class CommandLimits(nn.Module):
    r"""Limits actions to a range, scales changes of a command, and limits the distance of the command from the robot.

    An action is clipped to its range first; what a planner or controller says far from its data has no bound of its
    own. Changes of a command follow:

    .. math::
        a' = \operatorname{clip}(c + g a - x,\; -l,\; l) - (c - x)

    with the last command ``c``, the measured position ``x``, an action ``a`` that changes the command, the gain ``g``
    and the lead ``l``, 0 for none, in the units of the actions. Where a robot is blocked, every plan that leads on adds
    to the command (integrator windup); with a lead it answers as soon as plans turn back.

    Args:
        actions (sequence of int): action columns that change the command; needed for a gain or lead.

    Keyword Args:
        ranges (sequence, optional): least and greatest number of every action column, None for one without limit.
        gain, lead (float): ``g`` and ``l``.
        commands (sequence of int): observation columns that repeat the last command; needed for a lead.
        positions (sequence of int): state columns of what each of them moves; likewise.
        state_of (callable, optional): from observations ``[*B, obs]`` to states ``[*B, d]``. Default: they are the
            same.

    Raises:
        ValueError: for a gain or lead where no action is a change of a command, or columns that differ in number.
    """

    def __init__(
        self,
        actions: Sequence[int] = (),
        *,
        ranges: Ranges | None = None,
        gain: float = 1.0,
        lead: float = 0.0,
        commands: Sequence[int] = (),
        positions: Sequence[int] = (),
        state_of: Callable[[Tensor], Tensor] | None = None,
    ):
        super().__init__()
        if not len(actions) and (ranges is None or gain != 1 or lead):
            raise ValueError(f"gain {gain:g} and lead {lead:g} were given, but no action is a change of a command")
        if lead and not (commands or positions):
            raise ValueError(f"lead {lead:g} was given, but the observation repeats no command that actions change")
        if lead and not len(commands) == len(positions) == len(actions):
            raise ValueError(
                "as many commands, positions and actions are needed, got"
                f" {len(commands)}, {len(positions)} and {len(actions)} columns"
            )
        self.gain, self.lead, self.state_of = gain, lead, state_of
        self.register_buffer("ends", None if ranges is None else ends_of(ranges), persistent=False)
        for name, columns in {"actions": actions, "commands": commands, "positions": positions}.items():
            self.register_buffer(name, torch.as_tensor(list(columns), dtype=torch.long), persistent=False)

    def forward(self, observations: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Limits actions ``[*B, act]``, given observations ``[*B, history, obs]``, the present one last.

        What is within the limits stays the same bit for bit: a rounding error changes episodes with contacts. The
        second tensor says whether a column left its range, bool ``[*B]``.
        """
        held = self._in_range(action)
        return self._paced(observations, held), (held != action).any(-1)

    def _in_range(self, action: Tensor) -> Tensor:
        if self.ends is None:
            return action
        if action.shape[-1] != len(self.ends):
            raise ValueError(f"ranges of {len(self.ends)} action columns were given, actions have {action.shape[-1]}")
        low, high = self.ends.to(action.dtype).unbind(-1)
        return action.clamp(low, high)

    def _paced(self, observations: Tensor, action: Tensor) -> Tensor:
        """Actions ``[*B, act]`` with gain and lead."""
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
