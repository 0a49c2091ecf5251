# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans that are followed by prediction: commands whose effect, by a model of the robot's response, is the plan."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.modules.execution.plan_then_control import PlanThenControl, blend_plan
from torchrl_koap.modules.koopman.command_response import CommandResponse
from torchrl_koap.modules.planning.planner import StatePlanner

SMOOTHNESS = 3.0  # weight of a change of the commanded velocity against a distance from the plan
END_SPEED = 5.0  # weight of the speed at the end of the look-ahead: a short one is unstable without


class PredictiveTracking(PlanThenControl):
    r"""Plans future states and follows them by model predictive control of the robot's response to its commands.

    An inverse dynamics is told what the robot shall do, not what it was told to do; how far its command is ahead of it
    decides what it does next, and the policy knows that command: it gave it. With the response
    (:class:`~torchrl_koap.modules.CommandResponse`), which is linear, the next changes ``a`` of the command come in
    closed form:

    .. math::
        \min_a \sum_{k=1}^{N} |y_k - p_k|^2 + \gamma^2 |(y_N - y_{N-1}) - (p_N - p_{N-1})|^2
            + \lambda \sum_{k=0}^{N-2} |a_k - a_{k-1}|^2

    with predicted positions ``y``, planned ones ``p`` and the last change ``a_{-1}``. The first change is executed, and
    the next step looks again (dynamic matrix control: Cutler and Ramaker, 1980). Action entries that the response does
    not know are decoded by the controller, as in :class:`~torchrl_koap.modules.PlanThenControl`.

    Args:
        planner (StatePlanner): plans states from the last observed ones.
        controller (InverseDynamics): decodes the other entries of the action.
        response (CommandResponse): the robot's response.

    Keyword Args:
        look_ahead (int, optional): ``N``. Default: what is planned of the future at every step of a plan.
        smoothness (float): ``lambda``.
        end_speed (float): ``gamma``.
        **options: as for :class:`~torchrl_koap.modules.PlanThenControl`.

    Raises:
        ValueError: as :class:`~torchrl_koap.modules.PlanThenControl`; if the execution is not ``"feedback"``, or
            ``look_ahead`` is not in 2 to the number of states that are planned.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import (
        ...     CommandResponse, MLPDenoiser, PredictiveTracking, StatePlanner, make_koopman_inverse_dynamics)
        >>> planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2, num_steps=2)
        >>> response = CommandResponse(states=[0, 1], commands=[0, 1], actions=[0, 1])
        >>> _ = response.weight[[0, 1], [0, 1], 2].fill_(0.3)
        >>> policy = PredictiveTracking(
        ...     planner, make_koopman_inverse_dynamics(2, 2), response, state_columns=(2, 3), history=5)
        >>> td = TensorDict({"observation_history": torch.zeros(3, 5, 4),
        ...                  "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
        >>> policy(td)["action"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        planner: StatePlanner,
        controller: TensorDictModuleBase,
        response: CommandResponse,
        *,
        look_ahead: int | None = None,
        smoothness: float = SMOOTHNESS,
        end_speed: float = END_SPEED,
        **options: Any,
    ):
        if options.get("execution", "feedback") != "feedback":
            raise ValueError(
                f"predictive tracking looks at every step: execution must be 'feedback', got {options['execution']!r}"
            )
        super().__init__(planner, controller, **options)
        known = planner.horizon - self.replan_interval + 1
        look_ahead = known if look_ahead is None else look_ahead
        if not 2 <= look_ahead <= planner.horizon:
            raise ValueError(
                f"look_ahead must be 2 to {planner.horizon} (the horizon), got {look_ahead}: plans of"
                f" {planner.horizon} states, of which {self.replan_interval} are executed, leave {known}"
            )
        if self.history < response.history:
            raise ValueError(f"the response reads {response.history} observed frames, history is only {self.history}")
        if smoothness <= 0 or end_speed < 0:
            raise ValueError(f"smoothness must be > 0 and end_speed >= 0, got {smoothness} and {end_speed}")
        self.response, self.look_ahead = response, look_ahead
        self.smoothness, self.end_speed = smoothness, end_speed
        self._gains: tuple[Tensor, Tensor] | None = None
        self._gains_of = response.weight.clone()

    def track(self, observed: Tensor, states: Tensor, plan: Tensor) -> Tensor:
        """The next actions of the tracked entries.

        Args:
            observed (Tensor): observations ``[*B, history, obs]``, raw units.
            states (Tensor): their states ``[*B, history, d]``.
            plan (Tensor): planned states ``[*B, H, d]``, the next one first.

        Returns:
            Tensor: ``[*B, look_ahead - 1, J]``, changes of the command, or commands where actions are absolute.
        """
        model = self.response
        positions, goal = states[..., model.states], plan[..., model.states]
        goal = blend_plan(positions, goal, self.blend_decay)[..., : self.look_ahead, :]
        positions = positions[..., -model.history :, :]
        commands = observed[..., -model.history :, model.commands]
        changes = commands.diff(dim=-2)
        command = commands[..., -1, :]
        held = goal.new_zeros(*goal.shape[:-2], self.look_ahead, model.num_axes)
        missing = (goal - model.predict(positions, command, changes, held)).flatten(-2)
        follow, keep = (gain.to(goal) for gain in self.gains())
        future = missing @ follow.T + changes[..., -1, :] @ keep.T
        future = future.unflatten(-1, (self.look_ahead - 1, model.num_axes))
        return command.unsqueeze(-2) + future.cumsum(-2) if model.absolute else future

    def gains(self) -> tuple[Tensor, Tensor]:
        """Gains of the distance from the plan if the command is held ``[(N - 1) J, N J]``, and of its last change."""
        weight = self.response.weight
        if self._gains is None or not (torch.compiler.is_compiling() or _equal(weight, self._gains_of)):
            self._gains_of = weight.clone()  # the response may have been fitted again
            steps, axes = self.look_ahead, self.response.num_axes
            effect = self.response.impulse_matrix(steps).reshape(steps * axes, (steps - 1) * axes)
            own = torch.eye(axes).to(effect)
            measured = torch.eye(steps * axes).to(effect)
            end = self.end_speed * torch.cat([-own, own], 1)
            measured = torch.cat([measured, torch.cat([end.new_zeros(axes, (steps - 2) * axes), end], 1)])
            effect = measured @ effect
            rough = torch.eye(steps - 1) - torch.diag(torch.ones(steps - 2), -1)
            rough = torch.kron(rough.to(effect), own)
            inverse = torch.linalg.inv(effect.T @ effect + self.smoothness * rough.T @ rough)
            self._gains = inverse @ effect.T @ measured, self.smoothness * inverse[:, :axes]
        return self._gains

    def decide(self, observed: Tensor, states: Tensor, cached: Tensor) -> Tensor:
        """The decoded action with the tracked entries; arguments as for :class:`RecedingHorizonPolicy`."""
        return self._with_tracked(self.act(states, cached), self.track(observed, states, cached)[..., 0, :])

    def _decode_ahead(self, observations: Tensor, states: Tensor, plan: Tensor) -> Tensor:
        """The actions of the next steps ``[*B, interval, act]``, as if the robot answered as predicted."""
        tracked = self.track(observations, states, plan)[..., : self.replan_interval, :]
        if (missing := self.replan_interval - tracked.shape[-2]) > 0:  # beyond the look-ahead the command is held
            last = tracked[..., -1:, :] if self.response.absolute else torch.zeros_like(tracked[..., -1:, :])
            tracked = torch.cat([tracked, last.expand(*last.shape[:-2], missing, -1)], -2)
        return self._with_tracked(self._decode_chunk(states, plan), tracked)

    def _with_tracked(self, action: Tensor, tracked: Tensor) -> Tensor:
        action = action.clone()
        action[..., self.response.actions] = tracked.to(action.dtype)
        return action


def _equal(weight: Tensor, other: Tensor) -> bool:
    return weight.device == other.device and weight.dtype == other.dtype and torch.equal(weight, other)
