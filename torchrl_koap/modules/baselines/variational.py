# This source code is licensed under the MIT license found in the LICENSE file.
"""A variational auto-encoder of short trajectories as controller."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.modules.time_alignment import FrameGatherer


class VariationalInverseDynamics(LatentInverseDynamics):
    r"""Encodes the steps around a frame in a Gaussian latent; an action decoder reads its mean.

    .. math::
        q(u_t \mid s_t) = N(\mu_\theta(s_t, x_t), \sigma^2_\theta(s_t, x_t)), \qquad
        \hat s_t = g_\psi(u_t, x_t), \quad u_t \sim q, \qquad a_t = d_\phi(\mu_\theta(s_t, x_t))

    with ``s_t`` the steps between the frames ``x_{t-n}, ..., x_{t+k}``
    (:class:`~torchrl_koap.modules.time_alignment.FrameGatherer`). Trained in two stages, as the paper says:
    :class:`~torchrl_koap.objectives.VariationalLoss` on all windows, then
    :class:`~torchrl_koap.objectives.LatentDecoderLoss` on the labelled frames with the encoder frozen.

    KOAP's first public code differs: it reconstructs from a deterministic code
    beside the latent, so that the latent need not hold anything; it feeds a sample to the action decoder, also at
    inference; and it trains all parts at once.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        latent_dim (int): size ``m`` of a latent. Defaults to ``16``.
        hidden_dims (sequence of int): widths of the three networks. Defaults to ``(128, 128)``.
        num_past (int): number ``n`` of frames before the present one. Defaults to ``4``.
        look_ahead (int or sequence of int): offsets ``k``. Defaults to ``(1, 2, 3, 4, 5)``.
        state_normalizer (nn.Module, optional): maps raw states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps decoded actions to raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``. Defaults to ``"action"``.

    Raises:
        ValueError: for a negative ``num_past`` or an offset below 1; at the call for states of another size.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> model = VariationalInverseDynamics(2, 2)
        >>> td = model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))
        >>> td["action"].shape, td["latent_action"].shape
        (torch.Size([3, 16, 2]), torch.Size([3, 16, 16]))
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        latent_dim: int = 16,
        hidden_dims: Sequence[int] = (128, 128),
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (1, 2, 3, 4, 5),
        **kwargs,
    ):
        reader = FrameGatherer(state_dim, num_past=num_past, look_ahead=look_ahead, least=1)
        layers = {"num_cells": hidden_dims, "activation_class": nn.ReLU}
        super().__init__(reader, MLP(latent_dim, action_dim, **layers), **kwargs)
        self.latent_dim = latent_dim
        self.encoder = MLP(reader.num_features, 2 * latent_dim, **layers)
        self.decoder = MLP(latent_dim + state_dim, reader.num_features - state_dim, **layers)

    def read(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What the encoder reads.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to read for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), num_features]``, in the networks' units.
        """
        return self.reader(self.normalize_state(state), frames)

    def split(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """The present state ``[*B, T, d]`` and the steps around it ``[*B, T, num_features - d]``."""
        size = self.reader.state_dim
        before, present, after = read.tensor_split((self.num_past * size, (self.num_past + 1) * size), -1)
        return present, torch.cat([before, after], -1)

    def posterior(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance ``[*B, T, m]`` of the latent."""
        mean, log_variance = self.encoder(read).chunk(2, -1)
        return mean, log_variance.clamp(-10.0, 10.0)  # one odd window must not overflow the exponential

    def reconstruct(self, latent: Tensor, present: Tensor) -> Tensor:
        """Steps around a state, from latents and the present state alone.

        Args:
            latent (Tensor): ``[*B, T, m]``.
            present (Tensor): present states ``[*B, T, d]`` (:meth:`split`).

        Returns:
            Tensor: ``[*B, T, num_features - d]``.
        """
        return self.decoder(torch.cat([latent, present], -1))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Means of the latents of a window of raw states.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to infer for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), m]``.
        """
        return self.posterior(self.read(state, frames))[0]
