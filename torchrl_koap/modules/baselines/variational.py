# This source code is licensed under the MIT license found in the LICENSE file.
"""A variational auto-encoder of whole observation windows as controller."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.modules.windows import WindowReader


class VariationalInverseDynamics(LatentInverseDynamics):
    r"""Encodes a whole window into a Gaussian latent per frame; samples of it are decoded into what the frame read.

    .. math::
        q(u_t \mid x_{0:T}) = N(\mu_\theta(h_t), \sigma^2_\theta(h_t)), \quad h = \mathrm{LSTM}_\theta(s_{0:T}), \qquad
        \hat s_t = g_\psi(u_t), \qquad a_t = d_\phi(u_t), \quad u_t \sim q

    with ``s_t`` the present state and the steps to and from it (:class:`~torchrl_koap.modules.WindowReader`), and an
    LSTM that runs over the window in both directions. Trained in two stages, as the paper says:
    :class:`~torchrl_koap.objectives.VariationalLoss` on all windows, then :class:`~torchrl_koap.objectives.ActionLoss`
    with ``freeze_latents`` and ``sample`` on the labelled frames. Where it acts it reads the mean. Args as for
    :class:`~torchrl_koap.modules.InverseDynamics`, and:

    Keyword Args:
        window (int): frames of the windows that it reads as a whole. Defaults to ``16``.
        latent_dim (int): size ``m`` of a latent. Defaults to ``16``.
        hidden_dim (int): size of the LSTM's state in either direction, and width of the decoders. Defaults to ``128``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> model = VariationalInverseDynamics(2, 2)
        >>> window = torch.randn(1, 16, 2)
        >>> changed = torch.cat([window[:, :-1], window[:, -1:] + 1], 1)
        >>> bool((model.infer(window)[:, 1] != model.infer(changed)[:, 1]).any())  # the whole window is read
        True
        >>> model.sample(window).shape
        torch.Size([1, 16, 16])
    """

    samples_latents = True

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
        reader = WindowReader(state_dim, num_past=1, look_ahead=1, min_offset=1)
        decoder = MLP(latent_dim, action_dim, num_cells=(hidden_dim, hidden_dim), activation_class=nn.ReLU)
        super().__init__(reader, decoder, **kwargs)
        self.window, self.latent_dim = window, latent_dim
        self.context = nn.LSTM(reader.num_features, hidden_dim, batch_first=True, bidirectional=True)
        self.encoder = nn.Linear(2 * hidden_dim, 2 * latent_dim)
        self.decoder = MLP(latent_dim, reader.num_features, num_cells=(hidden_dim,), activation_class=nn.ReLU)

    @property
    def num_window_frames(self) -> int:
        """Frames of the windows that are read as a whole."""
        return self.window

    def posterior(self, state: Tensor, frames: range | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Infers the distribution of the latents of a window of raw states ``[*B, T, d]``.

        Returns:
            tuple of Tensor: what every frame read ``[*B, len(frames), 3 d]``, at unit scale; mean and log-variance of
            the latents ``[*B, len(frames), m]``.
        """
        read = self.reader(self.normalize_state(state))  # [*B, T, F]
        context, _ = self.context(read.reshape(-1, *read.shape[-2:]))
        context = context.reshape(*read.shape[:-1], 2 * self.context.hidden_size)
        if frames is not None:
            read, context = (part[..., frames.start : frames.stop, :] for part in (read, context))
        mean, log_variance = self.encoder(context).chunk(2, -1)
        return read, mean, log_variance.clamp(-10.0, 10.0)  # one odd window must not overflow the exponential

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Infers the means ``[*B, len(frames), m]`` of the latents of a window of raw states ``[*B, T, d]``."""
        return self.posterior(state, frames)[1]

    def sample(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Samples latents ``[*B, len(frames), m]`` of a window of raw states ``[*B, T, d]``."""
        _, mean, log_variance = self.posterior(state, frames)
        return mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
