# This source code is licensed under the MIT license found in the LICENSE file.
"""Inverse dynamics networks without linear maps: a supervised one, and KOAP with perceptrons for all maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.koopman.inverse_dynamics import LiftedInverseDynamics
from torchrl_koap.modules.koopman.latent_action import LatentActionMLP
from torchrl_koap.modules.koopman.lifting import KoopmanLifting
from torchrl_koap.modules.windows import WindowReader

LATENT_DIM = 32  # size of a lifted state and of a latent action, as in KOAP's default
LAYERS: dict[str, Any] = {"num_cells": (128, 128), "activation_class": nn.ReLU}


class SupervisedInverseDynamics(InverseDynamics):
    r"""Predicts the action of a step from the frames around it by a perceptron, trained on labels.

    .. math::
        a_t = f(x_{t-n}, \dots, x_t, x_{t+k_1}, x_{t+k_2}, \dots)

    With ``look_ahead=1`` this is the inverse dynamics of Decision Diffuser, which reads no state beyond the next one.
    Trained by :class:`~torchrl_koap.objectives.ActionLoss`. Args as for :class:`~torchrl_koap.modules.InverseDynamics`,
    offsets ``k >= 1``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import SupervisedInverseDynamics
        >>> model = SupervisedInverseDynamics(2, 2, look_ahead=(1, 4))
        >>> model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))["action"].shape
        torch.Size([3, 16, 2])
    """

    def __init__(
        self, state_dim: int, action_dim: int, *, num_past: int = 4, look_ahead: int | Sequence[int] = 1, **kwargs
    ):
        super().__init__(WindowReader(state_dim, num_past=num_past, look_ahead=look_ahead, min_offset=1), **kwargs)
        self.network = MLP(self.reader.num_features, action_dim, **LAYERS)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Applies the perceptron to the input of every frame."""
        return self.network(self.reader(self.normalize_state(state), frames))


class NonlinearInverseDynamics(LiftedInverseDynamics):
    r"""KOAP with nonlinear latent dynamics and a nonlinear action decoder.

    .. math::
        z_t = g_\theta(x_t), \qquad u_t = f_\theta(x_{t-n}, \dots, x_t, x_{t+k}), \qquad
        \hat z_{t+1} = h_\theta(z_t, u_t), \qquad \hat a_t = d_\phi(u_t)

    All parts are perceptrons, trained together by :class:`~torchrl_koap.objectives.KOAPLoss`. As in KOAP, ``f`` reads
    steps at unit scale and never ``x_{t+1}``, which the dynamics predict. Sizes are those of KOAP's default. Args as
    for :class:`~torchrl_koap.modules.InverseDynamics`, offsets ``k >= 2``.

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
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (2, 3, 4, 5),
        **kwargs,
    ):
        super().__init__(
            LatentActionMLP(state_dim, LATENT_DIM, num_past=num_past, look_ahead=look_ahead, relative=True),
            MLP(LATENT_DIM, action_dim, **LAYERS),
            KoopmanLifting(state_dim, LATENT_DIM, hidden_dims=(64, 64)),
            **kwargs,
        )
        self.dynamics = MLP(2 * LATENT_DIM, LATENT_DIM, **LAYERS)

    def predict_next(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Predicts ``z_{t+1}`` by the network ``h``."""
        return self.dynamics(torch.cat([lifted, latent_action], -1))
