# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear operator ``K``, which moves lifted states on by one step."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.keys import LATENT_ACTION, LIFTED_STATE


class KoopmanOperator(TensorDictModuleBase):
    r"""Moves lifted states on by one step, with a dense matrix and a latent action.

    .. math::
        z_{t+1} = K z_t + u_t \quad\text{or, with an input matrix,}\quad z_{t+1} = K z_t + B u_t

    Args:
        latent_dim (int): size ``m`` of a lifted state (and of a latent action, without an input matrix).

    Keyword Args:
        input_dim (int, optional): size ``p`` of a latent action; adds the matrix ``B`` ``[m, p]``, zero at first.
            Default: no ``B``, as in the paper. With ``B`` a latent action may hold more than the next state shows.
        in_keys (sequence of NestedKey): lifted state ``[*B, T, m]`` and latent action ``[*B, T, m or p]``.
        out_key (NestedKey): predicted next lifted state ``[*B, T, m]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import KoopmanOperator
        >>> operator = KoopmanOperator(4, input_dim=6)
        >>> td = TensorDict({"lifted_state": torch.randn(5, 16, 4), "latent_action": torch.randn(5, 16, 6)}, [5, 16])
        >>> operator(td)["next", "lifted_state"].shape, operator.eigenvalues().shape
        (torch.Size([5, 16, 4]), torch.Size([4]))
    """

    def __init__(
        self,
        latent_dim: int,
        *,
        input_dim: int | None = None,
        in_keys: Sequence[NestedKey] = (LIFTED_STATE, LATENT_ACTION),
        out_key: NestedKey = ("next", LIFTED_STATE),
    ):
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        self.latent_dim, self.input_dim = latent_dim, latent_dim if input_dim is None else input_dim
        self.weight = nn.Parameter(torch.empty(latent_dim, latent_dim))
        self.input = None if input_dim is None else nn.Parameter(torch.zeros(latent_dim, input_dim))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draws ``K`` near the identity, and sets ``B`` to zero."""
        if self.input is not None:
            self.input.zero_()
        self.weight.normal_(std=1e-3).add_(
            torch.eye(self.latent_dim, dtype=self.weight.dtype, device=self.weight.device)
        )

    def eigenvalues(self) -> Tensor:
        """Computes the eigenvalues of ``K``, complex ``[m]``, largest modulus first."""
        values = torch.linalg.eigvals(self.weight.detach())
        return values[values.abs().argsort(descending=True)]

    def step(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Computes lifted states ``[*B, T, m]`` one step later, ``K z + u``, or ``K z + B u`` with an input matrix."""
        following = lifted @ self.weight.mT
        return following + (latent_action if self.input is None else latent_action @ self.input.mT)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the predicted next lifted state."""
        lifted, latent_action = (tensordict.get(key) for key in self.in_keys)
        return tensordict.set(self.out_keys[0], self.step(lifted, latent_action))
