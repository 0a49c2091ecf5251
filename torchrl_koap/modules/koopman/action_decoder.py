# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear decoder from latent actions to robot actions, trained by gradients or fitted in closed form."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torchrl_koap.keys import ACTION, LATENT_ACTION
from torchrl_koap.modules.ridge import RidgeFit


class LinearActionDecoder(TensorDictModuleBase):
    r"""Decodes latent actions linearly: :math:`a_t = D u_t + b`.

    Args:
        latent_dim (int): size ``m`` of a latent action.
        action_dim (int): size of an action.

    Keyword Args:
        in_key (NestedKey): latent actions ``[*B, T, m]``. Defaults to ``"latent_action"``.
        out_key (NestedKey): actions ``[*B, T, act]`` in normalised units. Defaults to ``"action"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LinearActionDecoder
        >>> from torchrl_koap.modules.ridge import ridge
        >>> decoder, latent = LinearActionDecoder(4, 2), torch.randn(50, 4)
        >>> decoder.assign(ridge(latent, latent[:, :2]))
        >>> td = decoder(TensorDict({"latent_action": latent}, [50]))
        >>> bool((td["action"] - latent[:, :2]).abs().max() < 1e-3)
        True
    """

    def __init__(
        self, latent_dim: int, action_dim: int, *, in_key: NestedKey = LATENT_ACTION, out_key: NestedKey = ACTION
    ):
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.linear = nn.Linear(latent_dim, action_dim)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the decoded actions."""
        return tensordict.set(self.out_keys[0], self.linear(tensordict.get(self.in_keys[0])))

    @torch.no_grad()
    def assign(self, fit: RidgeFit) -> None:
        """Takes over the weights of a ridge regression from latent actions to normalised actions."""
        self.linear.weight.copy_(fit.weight)
        self.linear.bias.copy_(fit.bias)
