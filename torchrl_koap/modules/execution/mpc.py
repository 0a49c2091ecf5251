# This source code is licensed under the MIT license found in the LICENSE file.
"""Model predictive control with a linear model of how the robot follows its commands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_koap.modules.execution.followers import Follower, blend_plan, command_rest

SMOOTHNESS = 3.0  # weight of changes of the commanded velocity, relative to distances from the plan
END_SPEED = 5.0  # weight of the error of the last planned step: a short look-ahead is unstable without it


class ResponseModel(nn.Module):
    r"""Predicts measured positions from position commands by linear dynamics of delayed coordinates.

    A position-controlled arm lags behind its command, and the lag determines its next motion. The coordinates of the
    model are the last ``m = 2`` steps of the measured positions ``x``, the distance from the present position to the
    command ``c``, and the last ``m`` changes ``a`` of the command:

    .. math::
        x_{t+1} = x_t + \sum_{k=0}^{m-1} A_k (x_{t-k} - x_{t-k-1}) + C (c_t - x_t) + \sum_{k=1}^{m} B_k a_{t-k},
        \qquad c_{t+1} = c_t + a_t

    This is a Koopman model with control whose lifting is a delay embedding (Korda and Mezić, 2018, Linear predictors
    for nonlinear dynamical systems, section 3). A command given at ``t`` affects measurements from ``t + 2`` on: each
    measurement is taken before the command of its control step takes effect.

    Args:
        states (sequence of int): state columns of the measured positions ``[J]``.
        commands (sequence of int): observation columns that repeat the last commands ``[J]``.
        actions (sequence of int): action columns that change, or set, these commands ``[J]``.

    Keyword Args:
        action_dim (int, optional): entries of an action. Default: ``J``.
        absolute (bool): an action is the command itself instead of its change. Defaults to ``False``.

    Raises:
        ValueError: if the numbers of columns differ, or are 0.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import ResponseModel
        >>> response = ResponseModel([0], [0], [0])
        >>> _ = response.weight[0, 0, 2].fill_(0.5)  # every step covers half of the distance to the command
        >>> x, none = torch.zeros(3, 1), torch.zeros(2, 1)
        >>> response.predict(x, torch.tensor([8.0]), none, torch.zeros(3, 1)).flatten().tolist()
        [4.0, 6.0, 7.0]
    """

    memory = 2  # number of past steps, and of past changes of the command, that the model reads

    def __init__(
        self,
        states: Sequence[int],
        commands: Sequence[int],
        actions: Sequence[int],
        *,
        action_dim: int | None = None,
        absolute: bool = False,
    ):
        super().__init__()
        sizes = {"states": len(states), "commands": len(commands), "actions": len(actions)}
        if len(set(sizes.values())) > 1 or not len(states):
            raise ValueError(f"states, commands and actions need one column per axis each, got {sizes}")
        self.states, self.commands, self.actions = list(states), list(commands), list(actions)
        self.action_dim = len(self.actions) if action_dim is None else action_dim
        self.absolute = absolute
        self.register_buffer("weight", torch.zeros(len(states), len(states), 2 * self.memory + 1))

    @property
    def num_axes(self) -> int:
        """The number ``J`` of axes."""
        return len(self.states)

    @property
    def history(self) -> int:
        """Observed frames that a prediction needs, the present one included."""
        return self.memory + 1

    def coordinates(self, positions: Tensor, lead: Tensor, changes: Tensor) -> Tensor:
        """Returns the regressors of the next step, ``[*B, J, 2 memory + 1]``.

        Measured positions are ``[*B, memory + 1, J]``, the present one last; ``lead`` is the distance from there to the
        command, ``[*B, J]``; changes of the command are ``[*B, memory, J]``, the latest last.
        """
        steps = positions.diff(dim=-2).flip(-2).movedim(-2, -1)
        return torch.cat([steps, lead.unsqueeze(-1), changes.flip(-2).movedim(-2, -1)], -1)

    def predict(
        self, positions: Tensor, command: Tensor, changes: Tensor, future: Tensor, *, weight: Tensor | None = None
    ) -> Tensor:
        """Predicts the next N positions ``[*B, N, J]`` under given changes of the command.

        Args:
            positions (Tensor): measured ``[*B, memory + 1, J]``, the present one last.
            command, changes (Tensor): the last command ``[*B, J]``, and its last changes ``[*B, memory, J]``.
            future (Tensor): future changes ``[*B, N, J]``; the last one has no effect within N steps.

        Keyword Args:
            weight (Tensor, optional): coefficients ``[J, J, 2 memory + 1]``. Default: those of the model.
        """
        weight, predicted = (self.weight if weight is None else weight).to(positions.dtype), []
        for change in future.unbind(-2):
            now = positions[..., -1, :]
            step = torch.einsum("...jf,kjf->...k", self.coordinates(positions, command - now, changes), weight)
            predicted.append(now + step)
            positions = torch.cat([positions[..., 1:, :], predicted[-1].unsqueeze(-2)], -2)
            command, changes = command + change, torch.cat([changes[..., 1:, :], change.unsqueeze(-2)], -2)
        return torch.stack(predicted, -2)

    def impulse_matrix(self, steps: int) -> Tensor:
        """Computes the effect of future changes of the command on the next ``N = steps`` positions.

        The result is float64 ``[N, J, N - 1, J]``: step and axis of the position, then step and axis of the change.
        """
        axes = self.num_axes
        pushes = torch.eye(steps * axes, dtype=torch.float64, device=self.weight.device)
        pushes = pushes.reshape(steps * axes, steps, axes)
        nothing = pushes.new_zeros(len(pushes), self.memory + 1, axes)
        moved = self.predict(nothing, nothing[:, 0], nothing[:, 1:], pushes)  # [N J, N, J]
        return moved.permute(1, 2, 0).reshape(steps, axes, steps, axes)[:, :, : steps - 1]

    @torch.no_grad()
    def fit_ridge(
        self, coordinates: Tensor, steps: Tensor, *, penalty: float = 1e-5, coupled: bool = True
    ) -> ResponseModel:
        """Fits this model to measured steps by ridge regression and returns it.

        Coordinates are ``[n, J, 2 memory + 1]`` (:meth:`coordinates`), the steps that followed ``[n, J]``; the penalty
        is relative to the coordinates' mean squares. ``coupled`` axes may respond to each other's commands; otherwise
        every axis is fitted separately.
        """
        axes, size = self.num_axes, 2 * self.memory + 1
        read, wanted = coordinates.double(), steps.double()
        scale = read.pow(2).mean(0).sqrt().clamp_min(1e-12)
        read = read / scale
        if coupled:
            weight = _ridge(read.flatten(1), wanted, penalty).T.reshape(axes, axes, size)
        else:
            weight = read.new_zeros(axes, axes, size)
            for axis in range(axes):
                weight[axis, axis] = _ridge(read[:, axis], wanted[:, axis : axis + 1], penalty)[:, 0]
        self.weight.copy_(weight / scale)
        return self


def _ridge(read: Tensor, wanted: Tensor, penalty: float) -> Tensor:
    """Returns the coefficients ``[f, k]`` that predict ``wanted [n, k]`` from ``read [n, f]``."""
    square = read.T @ read
    square.diagonal().add_(penalty * len(read))
    return torch.linalg.solve(square, read.T @ wanted)


class MPC(Follower):
    r"""Follows plans by model predictive control of the robot's response to its commands.

    The distance of the command from the robot determines the robot's next motion. MPC reads the last command; an
    inverse dynamics model reads only states. The response (:class:`~torchrl_koap.modules.ResponseModel`) is linear, so
    the next changes ``a`` of the command have a closed form:

    .. math::
        \min_a \sum_{k=1}^{N} |y_k - p_k|^2 + \gamma^2 |(y_N - y_{N-1}) - (p_N - p_{N-1})|^2
            + \lambda \sum_{k=0}^{N-2} |a_k - a_{k-1}|^2

    with predicted positions ``y``, planned ones ``p``, the last change ``a_{-1}``, ``lambda = 3``, ``gamma = 5``. The
    first change is executed; the next step solves again (dynamic matrix control: Cutler and Ramaker, 1980).

    Args:
        response (ResponseModel): the fitted response of the robot; gains are computed once (:meth:`refresh`).

    Keyword Args:
        look_ahead (int): number ``N`` of planned states that are read.
        **options: ``blend`` and ``action_rule`` of ``Follower``; the rule sets the action entries that the response
            does not model.

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
            raise ValueError(f"look_ahead must be at least 2, got {look_ahead}: lower replan_interval")
        self.look_ahead = look_ahead
        for name in ("follow_gain", "keep_gain"):
            self.register_buffer(name, None, persistent=False)
        self.refresh()
        self.register_load_state_dict_post_hook(type(self).refresh)

    def refresh(self, *_: Any) -> None:
        """Solves the quadratic problem for all plans; call it after the response changes. Loading weights calls it.

        The gain of the distance from the plan under a constant command is ``[(N - 1) J, N J]``, that of the last change
        of the command ``[(N - 1) J, J]``; both are float64.
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
        """Computes the actions of the next steps; beyond the look-ahead the command is held."""
        model = self.controller
        tracked = self.track(observations, states, plan)[..., :steps, :]
        if (missing := steps - tracked.shape[-2]) > 0:
            last = tracked[..., -1:, :] if model.absolute else torch.zeros_like(tracked[..., -1:, :])
            tracked = torch.cat([tracked, last.expand(*last.shape[:-2], missing, -1)], -2)
        actions = command_rest(self.action_rule, states, plan, model.action_dim, steps)
        actions[..., model.actions] = tracked.to(actions.dtype)
        return actions

    def track(self, observations: Tensor, states: Tensor, plan: Tensor) -> Tensor:
        """Computes the next actions ``[*B, look_ahead - 1, J]`` of the entries that the response models.

        They are changes of the command, or commands if actions are absolute; arguments as for :class:`Follower`.
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
