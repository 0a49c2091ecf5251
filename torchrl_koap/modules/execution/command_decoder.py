# This source code is licensed under the MIT license found in the LICENSE file.
"""Command regression: the command that demonstrations had in a state, and plans that are followed by it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.execution.followers import Follower, blend_plan, command_rest
from torchrl_koap.modules.normalizer import Normalizer

DEPTH = 3  # hidden layers of the lifting
FEEDBACK_GAIN = 0.3  # share of the distance to the decoded command that is gone at every step


class CommandDecoder(nn.Module):
    r"""Decodes the command of a state, not its change, from a lifted state.

    .. math::
        c_t = W g(x_t) + b, \qquad a_t = c_{t+1} - c_t = W (z_{t+1} - z_t), \quad z_t = g(x_t)

    Changes that are decoded add up along a path to what depends on its ends alone. Where actions move more than is
    seen, as a joint does that turns the hand about the tool, changes that are decoded one by one add up to a command
    that no demonstration had, and nothing observed tells; one that is decoded whole says where it ought to be.

    Args:
        state_dim (int): columns of the state ``d``.
        commands (sequence of int): columns of the observation that repeat the commands ``[J]``.
        actions (sequence of int): columns of the action that change them ``[J]``.

    Keyword Args:
        action_dim (int, optional): entries of an action. Default: those that change a command.
        features (Module, optional): what the lifting reads besides, such as relative positions: from ``[*B, 1, d]`` to
            ``[*B, num_features]``.
        width (int): of the lifting ``g``, a perceptron, and of ``z``. Defaults to ``256``.

    Raises:
        ValueError: if a size is below 1, or the columns of commands and actions differ in number.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import CommandDecoder
        >>> decoder = CommandDecoder(4, [0, 1], [0, 1], width=8)
        >>> decoder.set_scales(torch.randn(9, 4), torch.randn(9, 2))
        >>> decoder(torch.zeros(5, 4)).shape
        torch.Size([5, 2])
    """

    def __init__(
        self,
        state_dim: int,
        commands: Sequence[int],
        actions: Sequence[int],
        *,
        action_dim: int | None = None,
        features: nn.Module | None = None,
        width: int = 256,
    ):
        super().__init__()
        if len(commands) != len(actions):
            raise ValueError(f"got {len(commands)} columns of commands and {len(actions)} of actions that change them")
        for name, size in {"state_dim": state_dim, "commands": len(commands), "width": width}.items():
            if size < 1:
                raise ValueError(f"{name} must be at least 1, got {size}")
        self.commands, self.actions = list(commands), list(actions)
        self.action_dim = len(self.actions) if action_dim is None else action_dim
        self.features = features
        inputs = state_dim + (0 if features is None else features.num_features)
        self.lifting = MLP(
            inputs, width, num_cells=[width] * (DEPTH - 1), activation_class=nn.SiLU, activate_last_layer=True
        )
        self.decoder = nn.Linear(width, len(actions))
        self.inputs, self.outputs = Normalizer(inputs), Normalizer(len(actions))

    def set_scales(self, states: Tensor, commands: Tensor) -> None:
        """Takes mean and standard deviation of states ``[N, d]`` and of commands ``[N, J]``."""
        self.inputs = Normalizer.fit(self._read(states), mode="standard")
        self.outputs = Normalizer.fit(commands, mode="standard")

    def scaled(self, states: Tensor) -> Tensor:
        """Commands ``[*B, J]`` in units of their standard deviation."""
        return self.decoder(self.lifting(self.inputs(self._read(states))))

    def forward(self, states: Tensor) -> Tensor:
        """The commands ``[*B, J]`` of states ``[*B, d]``, both in raw units."""
        return self.outputs.inverse(self.scaled(states))

    def _read(self, states: Tensor) -> Tensor:
        return states if self.features is None else torch.cat([states, self.features(states.unsqueeze(-2))], -1)


class CommandRegression(Follower):
    r"""Follows plans by changes of the predicted command, and moves the command towards the predicted one.

    .. math::
        a_t = f(p_{t+1}) - f(x_t) + \rho\, (f(x_t) - c_t)

    with the decoded command ``f`` (the ``controller``, a :class:`CommandDecoder`), the plan ``p`` bent into the present
    state, the last command ``c``, which the policy knows, and the feedback gain ``rho = 0.3``. The first part moves
    what is seen; the second keeps what is not seen where demonstrations had it. The rule of actions tells the other
    entries.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import CommandDecoder, CommandRegression
        >>> decoder = CommandDecoder(2, [0, 1], [0, 1], width=8)
        >>> decoder.set_scales(torch.randn(9, 2), torch.randn(9, 2))
        >>> CommandRegression(decoder)(torch.zeros(3, 1, 4), torch.zeros(3, 1, 2), torch.zeros(3, 14, 2)).shape
        torch.Size([3, 1, 2])
    """

    knows_command = True

    def forward(self, observations: Tensor, states: Tensor, plan: Tensor, steps: int = 1) -> Tensor:
        """The actions of the next steps; arguments as for :class:`Follower`."""
        model, now = self.controller, states[..., -1, :]
        bent = blend_plan(states, plan, self.blend)[..., :steps, :]
        decoded = model(torch.cat([now.unsqueeze(-2), bent], -2))
        command, changes = observations[..., -1, model.commands], []
        for step, before in zip(decoded.diff(dim=-2).unbind(-2), decoded.unbind(-2)[:-1], strict=True):
            changes.append(step + FEEDBACK_GAIN * (before - command))
            command = command + changes[-1]
        actions = command_rest(self.action_rule, states, plan, model.action_dim, steps)
        actions[..., model.actions] = torch.stack(changes, -2).to(actions.dtype)
        return actions
