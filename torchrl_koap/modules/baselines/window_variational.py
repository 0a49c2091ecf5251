# This source code is licensed under the MIT license found in the LICENSE file.
"""A variational auto-encoder of whole observation windows as controller."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_koap.modules.baselines.variational import VariationalInverseDynamics


class WindowVariationalInverseDynamics(VariationalInverseDynamics):
    r"""Encodes a whole window into a Gaussian latent per frame; samples of it are decoded into what the frame read.

    .. math::
        q(u_t \mid x_{0:T}) = N(\mu_\theta(h_t), \sigma^2_\theta(h_t)), \quad h = \mathrm{LSTM}_\theta(s_{0:T}), \qquad
        \hat s_t = g_\psi(u_t), \qquad a_t = d_\phi(u_t), \quad u_t \sim q

    with ``s_t`` the present state and the steps to and from it, and an LSTM that runs over the window in both
    directions. Unlike :class:`VariationalInverseDynamics`, the decoder of the states is not handed the present one, and
    the action decoder is fitted to samples (:class:`~torchrl_koap.objectives.LatentDecoderLoss` with ``samples=True``).
    Where it acts it reads the mean, so that a state always has the same action; noise could only make that worse.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        window (int): frames of the windows that it reads as a whole. Defaults to ``16``.
        latent_dim (int): size ``m`` of a latent. Defaults to ``16``.
        hidden_dim (int): size of the LSTM's state in either direction, and width of the decoders. Defaults to ``128``.
        **kwargs: normalisers and keys, see :class:`~torchrl_koap.modules.InverseDynamics`.

    Raises:
        ValueError: at the call for states of another size.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import WindowVariationalInverseDynamics
        >>> model = WindowVariationalInverseDynamics(2, 2)
        >>> window = torch.randn(1, 16, 2)
        >>> changed = torch.cat([window[:, :-1], window[:, -1:] + 1], 1)
        >>> bool((model.infer(window)[:, 1] != model.infer(changed)[:, 1]).any())  # the whole window is read
        True
        >>> model.sample(window).shape
        torch.Size([1, 16, 16])
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        window: int = 16,
        latent_dim: int = 16,
        hidden_dim: int = 128,
        **kwargs,
    ):
        super().__init__(
            state_dim,
            action_dim,
            latent_dim=latent_dim,
            hidden_dims=(hidden_dim, hidden_dim),
            num_past=1,
            look_ahead=1,
            **kwargs,
        )
        self.window = window
        size = self.reader.num_features
        self.context = nn.LSTM(size, hidden_dim, batch_first=True, bidirectional=True)
        self.encoder = nn.Linear(2 * hidden_dim, 2 * latent_dim)
        self.decoder = nn.Sequential(nn.Linear(latent_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, size))

    @property
    def num_window_frames(self) -> int:
        """Frames of the windows that are read as a whole."""
        return self.window

    def read(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What every frame shows, and beside it what the encoder knows of the whole window.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to read for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), num_features + 2 * hidden_dim]``.
        """
        shown = self.reader(self.normalize_state(state))  # [*B, T, F]
        context, _ = self.context(shown.reshape(-1, *shown.shape[-2:]))
        read = torch.cat([shown, context.reshape(*shown.shape[:-1], 2 * self.context.hidden_size)], -1)
        return read if frames is None else read[..., frames.start : frames.stop, :]

    def split(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """Nothing that the decoder is handed besides the latent ``[*B, T, 0]``, and what it has to reconstruct."""
        return read[..., :0], read[..., : self.reader.num_features]

    def posterior(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance ``[*B, T, m]`` of the latent."""
        return super().posterior(read[..., self.reader.num_features :])

    def sample(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Samples of the latents of a window of raw states.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to infer for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), m]``.
        """
        mean, log_variance = self.posterior(self.read(state, frames))
        return mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
