# This source code is licensed under the MIT license found in the LICENSE file.
"""Applies limits, gain and lead to commands (:class:`Execution`)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

Ranges = Sequence[Sequence[float] | None]  # minimum and maximum of every column; None: unlimited


def ends_of(ranges: Ranges) -> Tensor:
    """Returns the minimum and maximum of every column, ``[act, 2]``; infinite if a column has no range."""
    return torch.tensor([(-math.inf, math.inf) if r is None else r for r in ranges])


class CommandLimits(nn.Module):
    r"""Limits actions to a range, scales changes of a command, and limits the distance of the command from the robot.

    First, actions are clipped to their range: far from their data, outputs of planner and controller are unbounded.
    Then gain and lead apply to the actions that change a command:

    .. math::
        a' = \operatorname{clip}(c + g a - x,\; -l,\; l) - (c - x)

    with the last command ``c``, the measured position ``x``, an action ``a`` that changes the command, the gain ``g``
    and the lead ``l`` in the units of the actions (0: no limit). While a robot is blocked, plans that lead further
    increase the command (integrator windup). With a lead, the robot responds as soon as a plan turns back.

    Args:
        actions (sequence of int): action columns that change the command; needed for a gain or lead.

    Keyword Args:
        ranges (sequence, optional): minimum and maximum of every action column; None: unlimited.
        gain, lead (float): ``g`` and ``l``.
        commands (sequence of int): observation columns that repeat the last command; needed for a lead.
        positions (sequence of int): state columns that these commands move; needed for a lead.
        state_of (callable, optional): maps observations ``[*B, obs]`` to states ``[*B, d]``. Default: identity.

    Raises:
        ValueError: for a gain or lead if no action changes a command, or if the numbers of columns differ.
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
        if not len(actions) and (gain != 1 or lead):
            raise ValueError(f"gain {gain:g} and lead {lead:g} were given, but no action is a change of a command")
        if lead and not (commands or positions):
            raise ValueError(f"lead {lead:g} was given, but the observation repeats no command that actions change")
        if lead and not len(commands) == len(positions) == len(actions):
            raise ValueError(
                "commands, positions and actions must have the same number of columns, got"
                f" {len(commands)}, {len(positions)} and {len(actions)}"
            )
        self.gain, self.lead, self.state_of = gain, lead, state_of
        self.register_buffer("ends", None if ranges is None else ends_of(ranges), persistent=False)
        for name, columns in {"actions": actions, "commands": commands, "positions": positions}.items():
            self.register_buffer(name, torch.as_tensor(list(columns), dtype=torch.long), persistent=False)

    def forward(self, observations: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """Limits actions ``[*B, act]``, given observations ``[*B, history, obs]``, the present one last.

        Actions within the limits stay the same bit for bit, since a rounding error changes episodes with contacts. The
        second result, bool ``[*B]``, says whether any column of an action was outside its range.
        """
        held = action
        if self.ends is not None:
            if action.shape[-1] != len(self.ends):
                raise ValueError(f"ranges has {len(self.ends)} columns, but actions have {action.shape[-1]}")
            held = action.clamp(*self.ends.to(action.dtype).unbind(-1))
        return self._paced(observations, held), (held != action).any(-1)

    def _paced(self, observations: Tensor, action: Tensor) -> Tensor:
        """Applies gain and lead to actions ``[*B, act]``."""
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
