# This source code is licensed under the MIT license found in the LICENSE file.
"""Model predictive control: commands whose effect, by a model of how the robot answers them, is the plan."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchrl_koap.modules.execution.followers import Follower, blend_plan, command_rest
from torchrl_koap.modules.execution.response_model import ResponseModel

SMOOTHNESS = 3.0  # weight of a change of the commanded velocity against a distance from the plan
END_SPEED = 5.0  # weight of the speed at the end of the look-ahead: a short one is unstable without


class MPC(Follower):
    r"""Follows plans by model predictive control of the robot's response to its commands.

    An inverse dynamics model reads the target state, not the last command. How far the command is ahead of the robot
    decides its next motion, and the policy knows the command. The response
    (:class:`~torchrl_koap.modules.ResponseModel`) is linear, so the next changes ``a`` of the command come in closed
    form:

    .. math::
        \min_a \sum_{k=1}^{N} |y_k - p_k|^2 + \gamma^2 |(y_N - y_{N-1}) - (p_N - p_{N-1})|^2
            + \lambda \sum_{k=0}^{N-2} |a_k - a_{k-1}|^2

    with predicted positions ``y``, planned ones ``p``, the last change ``a_{-1}``, ``lambda = 3``, ``gamma = 5``. The
    first change is executed, and the next step looks again (dynamic matrix control: Cutler and Ramaker, 1980).

    Args:
        response (ResponseModel): the robot's response, fitted: gains are computed once (:meth:`refresh`).

    Keyword Args:
        look_ahead (int): ``N``, planned states that are looked at.
        **options: ``blend`` and ``action_rule``, which tells the entries that the response does not know, see
            :class:`~torchrl_koap.modules.Follower`.

    Raises:
        ValueError: for a look-ahead below 2.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import MPC, ResponseModel
        >>> response = ResponseModel(states=[0, 1], commands=[0, 1], actions=[0, 1])
        >>> _ = response.weight[[0, 1], [0, 1], 2].fill_(0.3)
        >>> MPC(response, look_ahead=11)(torch.zeros(3, 3, 4), torch.zeros(3, 3, 2), torch.zeros(3, 14, 2)).shape
        torch.Size([3, 1, 2])
    """

    knows_command = True

    def __init__(self, response: ResponseModel, *, look_ahead: int, **options: Any):
        super().__init__(response, num_frames=response.history, **options)
        if look_ahead < 2:
            raise ValueError(f"look_ahead must be at least 2, got {look_ahead}")
        self.look_ahead = look_ahead
        for name in ("follow_gain", "keep_gain"):
            self.register_buffer(name, None, persistent=False)
        self.refresh()
        self.register_load_state_dict_post_hook(lambda self, _: self.refresh())

    def refresh(self) -> None:
        """Solves the quadratic problem once for all plans, anew for another response; loading weights does so too.

        The gain of the distance from the plan if the command is held is ``[(N - 1) J, N J]``, that of the last change
        of the command ``[(N - 1) J, J]``; both float64.
        """
        axes, steps = self.controller.num_axes, self.look_ahead
        effect = self.controller.impulse_matrix(steps).reshape(steps * axes, (steps - 1) * axes)
        own = torch.eye(axes).to(effect)
        end = END_SPEED * torch.cat([-own, own], 1)
        measured = torch.eye(steps * axes).to(effect)
        measured = torch.cat([measured, torch.cat([end.new_zeros(axes, (steps - 2) * axes), end], 1)])
        effect = measured @ effect
        rough = torch.eye(steps - 1) - torch.diag(torch.ones(steps - 2), -1)
        rough = torch.kron(rough.to(effect), own)
        inverse = torch.linalg.inv(effect.T @ effect + SMOOTHNESS * rough.T @ rough)
        self.follow_gain, self.keep_gain = inverse @ effect.T @ measured, SMOOTHNESS * inverse[:, :axes]

    def forward(self, observations: Tensor, states: Tensor, plan: Tensor, steps: int = 1) -> Tensor:
        """The actions of the next steps, as if the robot answered as predicted; beyond the look-ahead it is held."""
        model = self.controller
        tracked = self.track(observations, states, plan)[..., :steps, :]
        if (missing := steps - tracked.shape[-2]) > 0:
            last = tracked[..., -1:, :] if model.absolute else torch.zeros_like(tracked[..., -1:, :])
            tracked = torch.cat([tracked, last.expand(*last.shape[:-2], missing, -1)], -2)
        actions = command_rest(self.action_rule, states, plan, model.action_dim, steps)
        actions[..., model.actions] = tracked.to(actions.dtype)
        return actions

    def track(self, observations: Tensor, states: Tensor, plan: Tensor) -> Tensor:
        """The next actions ``[*B, look_ahead - 1, J]`` of the entries that the response knows.

        They are changes of the command, or commands where actions are absolute; arguments as for :class:`Follower`.
        """
        model = self.controller
        positions, goal = states[..., model.states], plan[..., model.states]
        goal = blend_plan(positions, goal, self.blend)[..., : self.look_ahead, :]
        positions = positions[..., -model.history :, :]
        commands = observations[..., -model.history :, model.commands]
        changes = commands.diff(dim=-2)
        command = commands[..., -1, :]
        held = goal.new_zeros(*goal.shape[:-2], self.look_ahead, model.num_axes)
        missing = (goal - model.predict(positions, command, changes, held)).flatten(-2)
        future = missing @ self.follow_gain.to(goal).T + changes[..., -1, :] @ self.keep_gain.to(goal).T
        future = future.unflatten(-1, (self.look_ahead - 1, model.num_axes))
        return command.unsqueeze(-2) + future.cumsum(-2) if model.absolute else future
