# This source code is licensed under the MIT license found in the LICENSE file.
"""The commands that demonstrations had in a state: a lifting whose steps are latent actions that can be summed up."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_koap.modules.normalizer import Normalizer


class CommandPosture(nn.Module):
    r"""Decodes the command in force, not its change, from a lifted state.

    .. math::
        c_t = W g(x_t) + b, \qquad a_t = c_{t+1} - c_t = W (z_{t+1} - z_t) = W u_t, \quad z_t = g(x_t)

    which is Koopman inverse dynamics (KOAP, section 4) with the operator ``K = 1``: the latent action is the step of
    the lifted state, and its sum over a path depends on the path's ends alone. Where actions move more than is seen, as
    a joint does that turns the hand about the tool, changes that are decoded one by one add up to a posture that no
    demonstration had, and nothing observed tells; a command that is decoded whole says where it ought to be.

    Args:
        state_dim (int): columns of the state ``d``.
        commands (sequence of int): columns of the observation that repeat the commands ``[J]``.
        actions (sequence of int): columns of the action that change them ``[J]``.

    Keyword Args:
        gripper (tuple of int, optional): action column of a gripper and state column of its width, whose number a
            policy reads off the planned widths.
        features (Module, optional): what the lifting reads besides, such as relative positions: from ``[*B, 1, d]`` to
            ``[*B, num_features]``.
        width (int): of the lifting ``g``, a perceptron, and of ``z``. Defaults to ``256``.
        depth (int): its hidden layers. Defaults to ``3``.

    Raises:
        ValueError: if a size is below 1, or the columns of commands and actions differ in number.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import CommandPosture
        >>> posture = CommandPosture(4, [0, 1], [0, 1], width=8)
        >>> posture.set_scales(torch.randn(9, 4), torch.randn(9, 2))
        >>> posture(torch.zeros(5, 4)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        state_dim: int,
        commands: Sequence[int],
        actions: Sequence[int],
        *,
        gripper: Sequence[int] | None = None,
        features: nn.Module | None = None,
        width: int = 256,
        depth: int = 3,
    ):
        super().__init__()
        if len(commands) != len(actions):
            raise ValueError(f"got {len(commands)} columns of commands and {len(actions)} of actions that change them")
        for name, size in {"state_dim": state_dim, "commands": len(commands), "width": width, "depth": depth}.items():
            if size < 1:
                raise ValueError(f"{name} must be at least 1, got {size}")
        self.commands, self.actions = list(commands), list(actions)
        self.gripper = None if gripper is None else tuple(gripper)
        self.features = features
        size = state_dim + (0 if features is None else features.num_features)
        layers: list[nn.Module] = []
        for _ in range(depth):
            layers += [nn.Linear(size, width), nn.SiLU()]
            size = width
        self.lifting, self.decoder = nn.Sequential(*layers), nn.Linear(size, len(actions))
        inputs = state_dim + (0 if features is None else features.num_features)
        self.inputs, self.outputs = Normalizer(inputs), Normalizer(len(actions))

    @property
    def num_axes(self) -> int:
        """``J``."""
        return self.decoder.out_features

    def set_scales(self, states: Tensor, commands: Tensor) -> None:
        """Takes mean and standard deviation of what is read and of what is decoded.

        Args:
            states (Tensor): ``[N, d]``.
            commands (Tensor): ``[N, J]``.
        """
        self.inputs = Normalizer.fit(self._read(states), mode="standard")
        self.outputs = Normalizer.fit(commands, mode="standard")

    def scaled(self, states: Tensor) -> Tensor:
        """Commands ``[*B, J]`` in units of their standard deviation."""
        return self.decoder(self.lifting(self.inputs(self._read(states))))

    def forward(self, states: Tensor) -> Tensor:
        """The commands in force.

        Args:
            states (Tensor): ``[*B, d]``, raw units.

        Returns:
            Tensor: ``[*B, J]``, the unit of the commands.
        """
        return self.outputs.inverse(self.scaled(states))

    def _read(self, states: Tensor) -> Tensor:
        return states if self.features is None else torch.cat([states, self.features(states.unsqueeze(-2))], -1)
