# This source code is licensed under the MIT license found in the LICENSE file.
"""A leash on the command: it may not run away from a robot that cannot follow (anti-windup)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.keys import ACTION
from torchrl_koap.modules.execution.receding_horizon import OBSERVATION_HISTORY


class CommandLeash(TensorDictModuleBase):
    r"""Holds back actions that would take the command too far ahead of the robot.

    .. math::
        a' = \operatorname{clip}(c + a - x,\; -l,\; l) - (c - x)

    with the last command ``c``, the measured position ``x`` and an action ``a`` that changes the command. Where a robot
    is blocked, at the end of its reach or by what it pushes against, every plan that leads on adds to the command,
    which nothing takes back (integrator windup): the command ends metres away, the arm turns over to reach it, and what
    is decided from then on hardly moves it. With the leash the robot answers as soon as plans turn back.

    It goes behind any policy in a ``TensorDictSequential``;
    :class:`~torchrl_koap.modules.RecedingHorizonPolicy` applies the one that is its attribute ``leash``. Exported
    policies have none: whoever calls them holds the command back.

    Args:
        lead (float): ``l``, farthest that the command may be ahead along every axis, in the units of the action.

    Keyword Args:
        commands (sequence of int): observation columns of the last command.
        positions (sequence of int): state columns of what each of them moves.
        actions (sequence of int): action columns that change them.
        state_of (callable, optional): from observations ``[*B, obs]`` to states ``[*B, d]``. Default: they are the
            same.
        history_key (NestedKey): observations ``[*B, history, obs]``, the present one last.
        action_key (NestedKey): action of the current step ``[*B, act]``, replaced.

    Raises:
        ValueError: for a lead that is not positive, or columns that differ in number.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import CommandLeash
        >>> leash = CommandLeash(0.1, commands=[0, 1], positions=[2, 3], actions=[0, 1])
        >>> ahead = torch.tensor([[0.59, 0.2, 0.5, 0.2]])  # commanded and measured xy (m)
        >>> td = TensorDict({"observation_history": ahead, "action": torch.full([2], 0.02)}, [])
        >>> leash(td)["action"]
        tensor([0.0100, 0.0200])
    """

    def __init__(
        self,
        lead: float,
        *,
        commands: Sequence[int],
        positions: Sequence[int],
        actions: Sequence[int],
        state_of: Callable[[Tensor], Tensor] | None = None,
        history_key: NestedKey = OBSERVATION_HISTORY,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        if not lead > 0:
            raise ValueError(f"lead must be above 0, got {lead}")
        if not len(commands) == len(positions) == len(actions):
            raise ValueError(
                "as many commands, positions and actions are needed, got"
                f" {len(commands)}, {len(positions)} and {len(actions)} columns"
            )
        self.in_keys, self.out_keys = [history_key, action_key], [action_key]
        self.lead, self.state_of = lead, state_of
        for name, columns in {"commands": commands, "positions": positions, "actions": actions}.items():
            self.register_buffer(name, torch.as_tensor(list(columns)), persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the action."""
        observed, action = (tensordict.get(key) for key in self.in_keys)
        return tensordict.set(self.out_keys[0], self.hold(observed, action))

    def hold(self, observed: Tensor, action: Tensor) -> Tensor:
        """The action that is left of one.

        Args:
            observed (Tensor): observations ``[*B, history, obs]``, the present one last.
            action (Tensor): ``[*B, act]``; not changed.

        Returns:
            Tensor: ``[*B, act]``; what is within the lead keeps its bits, for episodes with contacts turn out otherwise
            for a rounding error.
        """
        frame, action = observed[..., -1, :], action.clone()
        state = frame if self.state_of is None else self.state_of(frame)
        ahead = (frame[..., self.commands] - state[..., self.positions]).to(action.dtype)
        wanted = action[..., self.actions]
        reach = ahead + wanted
        held = reach.clamp(-self.lead, self.lead)
        action[..., self.actions] = torch.where(held == reach, wanted, held - ahead)
        return action
