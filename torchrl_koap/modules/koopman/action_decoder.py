# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear decoder from latent actions to robot actions, trained by gradients or fitted in closed form."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, LATENT_ACTION
from torchrl_koap.modules.ridge import RidgeFit, ridge


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
        >>> decoder, latent = LinearActionDecoder(4, 2), torch.randn(50, 4)
        >>> fit = decoder.fit(latent, latent[:, :2], torch.ones(50, dtype=torch.bool))
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

    def fit(self, latent: Tensor, action: Tensor, mask: Tensor, *, groups: Tensor | None = None, **options) -> RidgeFit:
        """Sets ``D`` and ``b`` by ridge regression (:func:`~torchrl_koap.modules.ridge.ridge`) on latent actions.

        Args:
            latent (Tensor): latent actions ``[*B, m]``.
            action (Tensor): actions ``[*B, act]``; anything, NaN included, where ``mask`` is False.
            mask (Tensor): labelled steps, bool ``[*B]``.

        Keyword Args:
            groups (Tensor, optional): group of every step, int64 ``[*B]``, left out together.
            **options: of :func:`~torchrl_koap.modules.ridge.ridge`.

        Returns:
            RidgeFit: the penalty chosen and its held-out errors.

        Raises:
            ValueError: if nothing is labelled, a labelled value is not finite, or shapes disagree.
        """
        if mask.dtype != torch.bool:
            raise ValueError(f"mask must be bool, got {mask.dtype}")
        if latent.shape[:-1] != action.shape[:-1] or mask.shape != latent.shape[:-1]:
            raise ValueError(
                f"latent {list(latent.shape)}, action {list(action.shape)} and mask {list(mask.shape)} must share"
                " their leading shape"
            )
        if groups is not None and groups.shape != mask.shape:
            raise ValueError(f"groups must have the shape of mask {list(mask.shape)}, got {list(groups.shape)}")
        found = ridge(latent[mask], action[mask], groups=None if groups is None else groups[mask], **options)
        self.assign(found)
        return found

    @torch.no_grad()
    def assign(self, fit: RidgeFit) -> None:
        """Takes over the weights of a ridge regression from latent actions to normalised actions."""
        self.linear.weight.copy_(fit.weight)
        self.linear.bias.copy_(fit.bias)
