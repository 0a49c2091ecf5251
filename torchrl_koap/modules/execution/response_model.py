# This source code is licensed under the MIT license found in the LICENSE file.
"""How a robot's measured axes answer its position commands: a linear model with control, on delayed coordinates."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class ResponseModel(nn.Module):
    r"""Predicts measured positions from position commands by linear dynamics of delayed coordinates.

    An arm under its tracking law is behind its command, and how far tells where it goes next. The coordinates of the
    model are the last steps of the measured positions ``x``, the distance from there to the command ``c``, and the last
    changes of the command ``a``, ``m = 2`` of each:

    .. math::
        x_{t+1} = x_t + \sum_{k=0}^{m-1} A_k (x_{t-k} - x_{t-k-1}) + C (c_t - x_t) + \sum_{k=1}^{m} B_k a_{t-k},
        \qquad c_{t+1} = c_t + a_t

    which is a Koopman model with control whose lifting is a delay embedding (Korda and Mezić, 2018, Linear predictors
    for nonlinear dynamical systems, section 3). What is commanded at ``t`` is seen from ``t + 2`` on: a measurement is
    taken before the command of its control step takes effect.

    Args:
        states (sequence of int): columns of the state that hold the measured positions ``[J]``.
        commands (sequence of int): columns of the observation that repeat the last commands ``[J]``.
        actions (sequence of int): columns of the action that change them, or set them ``[J]``.

    Keyword Args:
        action_dim (int, optional): entries of an action. Default: those that move an axis.
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

    memory = 2  # past steps, and past changes of the command, that are read

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
        """``J``."""
        return len(self.states)

    @property
    def history(self) -> int:
        """Observed frames that a prediction needs, the present one included."""
        return self.memory + 1

    def coordinates(self, positions: Tensor, lead: Tensor, changes: Tensor) -> Tensor:
        """What the next step is linear in, ``[*B, J, 2 memory + 1]``.

        Args:
            positions (Tensor): measured ``[*B, memory + 1, J]``, the present one last.
            lead (Tensor): distance from the present position to the command ``[*B, J]``.
            changes (Tensor): of the command ``[*B, memory, J]``, the latest last.
        """
        steps = positions.diff(dim=-2).flip(-2).movedim(-2, -1)
        return torch.cat([steps, lead.unsqueeze(-1), changes.flip(-2).movedim(-2, -1)], -1)

    def predict(
        self, positions: Tensor, command: Tensor, changes: Tensor, future: Tensor, *, weight: Tensor | None = None
    ) -> Tensor:
        """The next N positions ``[*B, N, J]`` under given changes of the command.

        Args:
            positions (Tensor): measured ``[*B, memory + 1, J]``, the present one last.
            command (Tensor): the last command ``[*B, J]``.
            changes (Tensor): that led to it ``[*B, memory, J]``, the latest last.
            future (Tensor): the changes to come ``[*B, N, J]``; the last one is not seen within N steps.

        Keyword Args:
            weight (Tensor, optional): coefficients ``[J, J, 2 memory + 1]`` to predict with. Default: its own.
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
        """Effect of every future change of the command on the next ``N = steps`` positions.

        Returns:
            Tensor: float64 ``[N, J, N - 1, J]``: of the change in step ``k`` of axis ``j`` (last two) on the positions.
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
        """Fits this model to measured steps by ridge regression, and returns it.

        Args:
            coordinates (Tensor): ``[n, J, 2 memory + 1]`` (:meth:`coordinates`).
            steps (Tensor): what followed ``[n, J]``.

        Keyword Args:
            penalty (float): ridge penalty, relative to the coordinates' mean squares.
            coupled (bool): an axis may answer the commands of others; else each one is fitted by itself.

        Raises:
            ValueError: if there is no step, or the shapes do not fit.
        """
        count, axes, size = len(steps), self.num_axes, 2 * self.memory + 1
        if not count or coordinates.shape != (count, axes, size) or steps.shape != (count, axes):
            raise ValueError(
                f"wanted coordinates [n, {axes}, {size}] and steps [n, {axes}], n >= 1, got"
                f" {list(coordinates.shape)} and {list(steps.shape)}"
            )
        read, wanted = coordinates.double(), steps.double()
        scale = read.pow(2).mean(0).sqrt().clamp_min(1e-12)
        read = read / scale
        if coupled:
            read = read.reshape(count, -1)
            weight = _ridge(read, wanted, penalty).T.reshape(axes, axes, size)
        else:
            weight = read.new_zeros(axes, axes, size)
            for axis in range(axes):
                weight[axis, axis] = _ridge(read[:, axis], wanted[:, axis : axis + 1], penalty)[:, 0]
        self.weight.copy_(weight / scale)
        return self


def _ridge(read: Tensor, wanted: Tensor, penalty: float) -> Tensor:
    """Coefficients ``[f, k]`` of ``read [n, f]`` for ``wanted [n, k]``."""
    square = read.T @ read
    square.diagonal().add_(penalty * len(read))
    return torch.linalg.solve(square, read.T @ wanted)
