# This source code is licensed under the MIT license found in the LICENSE file.
"""Follower modules, which turn plans into actions: the base class, and inverse dynamics as a follower."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_koap.modules.inverse_dynamics import InverseDynamics

ActionRule = Callable[[Tensor, Tensor], Tensor]  # (states [*B, T, d], actions [*B, T, act]) -> actions
# weights, times 5, that extrapolate a plan's first five states to the present
_AT_PRESENT = (9.0, 0.0, -4.0, -3.0, 3.0)


class Follower(nn.Module):
    """Base class of modules that turn a plan into actions; a subclass defines ``forward``.

    Args:
        controller (nn.Module, optional): model that decodes actions; its weights are saved.

    Keyword Args:
        num_frames (int): observed frames that it reads, the present one included.
        blend (float): share of the distance to the plan that remains after each frame (:func:`blend_plan`).
        action_rule (callable, optional): ``action_rule(states [*B, T, d], actions [*B, T, act]) -> actions`` is applied
            last to the actions of a window, for example to set a gripper command; ``task.action_rule``.

    A follower with ``knows_command`` reads the last command. It decodes at every step, and no gain applies to it.
    """

    knows_command = False

    def __init__(
        self,
        controller: nn.Module | None = None,
        *,
        num_frames: int = 1,
        blend: float = 0.8,
        action_rule: ActionRule | None = None,
    ):
        super().__init__()
        self.controller, self.num_frames = controller, num_frames
        self.blend, self.action_rule = blend, action_rule

    def forward(self, observations: Tensor, states: Tensor, plan: Tensor, steps: int = 1) -> Tensor:
        """Returns the actions of the next steps ``[*B, steps, act]``, raw units.

        Observations are ``[*B, history, obs]`` and their states ``[*B, history, d]``, the present one last; the plan is
        ``[*B, H, d]``, the next state first. Actions after the first assume that every planned state is reached.
        """
        raise NotImplementedError

    def attach(self, env: EnvBase) -> None:
        """Receives the batch of environments before their episodes begin; only running episodes are decoded later."""


class InverseDynamicsFollower(Follower):
    """Decodes actions from the window of observed and planned states.

    Before decoding, the plan is *blended* into the present state (:func:`blend_plan`). An inverse dynamics is fitted to
    recorded motions, which contain no jumps, so it follows a plan badly that begins away from the robot.

    The controller is an InverseDynamics, or another module with ``num_past`` that reads a window of states ``[*B, T,
    d]`` and writes actions ``[*B, T, act]``. ``reads`` selects its input from states ``[*B, T, w]``; default: all.
    """

    def __init__(self, controller: InverseDynamics, *, reads: Callable[[Tensor], Tensor] | None = None, **options: Any):
        super().__init__(controller, num_frames=controller.num_past + 1, **options)
        self.reads = reads

    def forward(self, observations: Tensor, states: Tensor, plan: Tensor, steps: int = 1) -> Tensor:
        """Decodes the actions of the next steps; arguments as for :class:`Follower`."""
        window = torch.cat([states, blend_plan(states, plan, self.blend)], -2)
        window = window if self.reads is None else self.reads(window)
        out = self.controller(TensorDict({self.controller.in_keys[0]: window}, batch_size=window.shape[:-2]))
        own = isinstance(self.controller, InverseDynamics)  # its out_keys may be selected
        actions = out[self.controller.out_key if own else self.controller.out_keys[-1]]
        if self.action_rule is not None:
            actions = self.action_rule(torch.cat([states, plan], -2), actions)
        now = states.shape[-2] - 1
        return actions[..., now : now + steps, :]


def command_rest(action_rule: ActionRule | None, states: Tensor, plan: Tensor, width: int, steps: int) -> Tensor:
    """Returns actions ``[*B, steps, width]`` of an action rule alone; entries that the rule does not set are zero.

    The other arguments are those of :class:`Follower`.
    """
    if action_rule is None:
        return plan.new_zeros(*plan.shape[:-2], steps, width)
    window, now = torch.cat([states, plan], -2), states.shape[-2] - 1
    return action_rule(window, window.new_zeros(*window.shape[:-1], width))[..., now : now + steps, :]


def remaining_plan(plan: Tensor, age: Tensor | int) -> Tensor:
    """Returns the rest of plans ``[*B, H, w]`` made ``age [*B]`` steps ago, padded by repeating the last state."""
    steps, last = torch.arange(plan.shape[-2], device=plan.device), plan.shape[-2] - 1
    if isinstance(age, int):
        return plan[..., (steps + age).clamp_max(last), :]
    index = (steps + age.unsqueeze(-1)).clamp_max(last)
    return plan.gather(-2, index.unsqueeze(-1).expand(plan.shape))


def blend_plan(history: Tensor, plan: Tensor, decay: float) -> Tensor:
    r"""Shifts a plan so that it begins at the present state; the shift decays along the plan.

    .. math::
        x'_{t+k} = x_{t+k} + \rho^k e, \qquad e = x_t - (9 x_{t+1} - 4 x_{t+3} - 3 x_{t+4} + 3 x_{t+5}) / 5

    where ``x_t`` is the present state and the fraction is the plan's present state: a least-squares parabola through
    its first five states, extrapolated backwards. A line would mistake acceleration for a distance to the robot.

    Args:
        history (Tensor): observed states ``[*B, h, d]``, the present one last.
        plan (Tensor): planned states ``[*B, H, d]``; plans of fewer than five states are returned unchanged.
        decay (float): ``rho``; 0 returns the plan unchanged.

    Returns:
        Tensor: the shifted plan ``[*B, H, d]``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import blend_plan
        >>> plan = torch.tensor([[2.0], [4.0], [7.0], [11.0], [16.0]])  # it was at 1
        >>> blend_plan(torch.tensor([[0.0]]), plan, 0.5).flatten().tolist()  # the robot is at 0
        [1.5, 3.75, 6.875, 10.9375, 15.96875]
    """
    if decay == 0 or plan.shape[-2] < len(_AT_PRESENT):
        return plan
    present = (plan.new_tensor(_AT_PRESENT).unsqueeze(-1) * plan[..., : len(_AT_PRESENT), :]).sum(-2) / 5
    behind = history[..., -1, :] - present
    frames = torch.arange(1, plan.shape[-2] + 1, device=plan.device, dtype=plan.dtype)
    return plan + behind.unsqueeze(-2) * (decay**frames).unsqueeze(-1)
