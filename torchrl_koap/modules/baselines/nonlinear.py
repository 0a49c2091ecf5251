# This source code is licensed under the MIT license found in the LICENSE file.
"""KOAP with both of its linear maps replaced by networks: what is the linearity worth?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.koopman.inverse_dynamics import LiftedInverseDynamics
from torchrl_koap.modules.koopman.latent_action import LatentActionMLP
from torchrl_koap.modules.koopman.lifting import KoopmanLifting


class NonlinearInverseDynamics(LiftedInverseDynamics):
    r"""Works as KOAP does, but with nonlinear latent dynamics and a nonlinear action decoder.

    .. math::
        z_t = g_\theta(x_t), \qquad u_t = f_\theta(x_{t-n}, \dots, x_t, x_{t+k}), \qquad
        \hat z_{t+1} = h_\theta(z_t, u_t), \qquad \hat a_t = d_\phi(u_t)

    All parts are perceptrons and trained together by :class:`~torchrl_koap.objectives.KOAPLoss`. As in KOAP,
    ``f`` reads steps at unit scale and never ``x_{t+1}``, which the dynamics have to predict. Args as for
    :class:`~torchrl_koap.modules.InverseDynamics`, offsets ``k >= 2``, and:

    Keyword Args:
        latent_dim (int): size ``m`` of a lifted state and of a latent action. Defaults to ``32``.
        hidden_dims (sequence of int): widths of ``f``, ``h`` and ``d``. Defaults to ``(128, 128)``.
        lifting_dims (sequence of int): widths of ``g`` and its inverse. Defaults to ``(64, 64)``, as KOAP's default.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import NonlinearInverseDynamics
        >>> model = NonlinearInverseDynamics(2, 2)
        >>> td = model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))
        >>> td["action"].shape, td["latent_action"].shape
        (torch.Size([3, 16, 2]), torch.Size([3, 16, 32]))
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        latent_dim: int = 32,
        hidden_dims: Sequence[int] = (128, 128),
        lifting_dims: Sequence[int] = (64, 64),
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (2, 3, 4, 5),
        **kwargs,
    ):
        frames: dict[str, Any] = {"num_past": num_past, "look_ahead": look_ahead, "relative": True}
        layers: dict[str, Any] = {"num_cells": hidden_dims, "activation_class": nn.ReLU}
        super().__init__(
            LatentActionMLP(state_dim, latent_dim, hidden_dims=hidden_dims, **frames),
            MLP(latent_dim, action_dim, **layers),
            KoopmanLifting(state_dim, latent_dim, hidden_dims=lifting_dims),
            **kwargs,
        )
        self.latent_dim, self.dynamics = latent_dim, MLP(2 * latent_dim, latent_dim, **layers)

    def predict_next(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Predicts ``z_{t+1}`` by the network ``h``."""
        return self.dynamics(torch.cat([lifted, latent_action], -1))
