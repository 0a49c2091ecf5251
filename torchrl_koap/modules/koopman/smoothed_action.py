# This source code is licensed under the MIT license found in the LICENSE file.
"""Latent actions of few, smoothed coordinates, fitted to unlabelled windows (preset ``semi_supervised``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_koap.modules.koopman.compact_lifting import BATCH, CompactLifting, noise_covariance
from torchrl_koap.modules.koopman.latent_action import LatentActionFourier, LatentActionModule
from torchrl_koap.modules.koopman.lifting import KoopmanLifting
from torchrl_koap.modules.windows import WindowReader

LIFTED, RAW = "lifted", "raw"
RAW_PAST, RAW_LOOK_AHEAD = 4, (2, 3, 4, 5)  # frames that the raw block reads
# The raw window is read if its held-out error is below this share of the lifted window's. The share is below 1: few
# held-out labels say little, and the lifted window was fitted to unlabelled windows.
RAW_SHARE = 0.85


class WienerSmoother(nn.Module):
    r"""Estimates the noise-free frames of a window from all of its frames (a Wiener smoother in closed form).

    .. math::
        \hat w = S (S + N)^{-1} w, \qquad S = \operatorname{cov}(w) - N, \qquad N = (I - \tfrac{1}{F} 1 1^T) \otimes R

    ``w`` are the ``F`` frames ``[F, dim]`` of a window minus their mean, and ``R`` is the covariance of white
    measurement noise. Such noise makes neighbouring steps anticorrelated. If the motion's own autocovariance is smooth
    in the lag, ``R`` is the distance of the autocovariance at lag 1 below the curve through lags 2 and 3
    (:func:`noise_covariance`). Without noise ``R`` is 0 and the window stays unchanged.
    """

    gain: Tensor

    def __init__(self, num_frames: int, dim: int):
        super().__init__()
        self.num_frames, self.dim = num_frames, dim
        self.register_buffer("gain", torch.eye(num_frames * dim))

    def forward(self, windows: Tensor) -> Tensor:
        """Smooths windows ``[*B, F, dim]``."""
        mean = windows.mean(-2, keepdim=True)
        return ((windows - mean).flatten(-2) @ self.gain.mT).unflatten(-1, (self.num_frames, self.dim)) + mean

    @torch.no_grad()
    def fit(self, windows: Tensor, consecutive: Tensor) -> None:
        """Fits the gain to windows ``[N, F, dim]`` of the frames that are smoothed together, without labels.

        The noise is estimated from ``consecutive`` frames, one control step apart: ``[N, T, dim]`` with ``T >= 5``.
        """
        centred = (windows - windows.mean(-2, keepdim=True)).flatten(-2).double()
        total = centred.mT @ centred / len(centred)
        frames = torch.eye(self.num_frames, dtype=torch.float64, device=windows.device) - 1 / self.num_frames
        noise = torch.kron(frames, noise_covariance(consecutive).to(total))
        values, vectors = torch.linalg.eigh(total - noise)
        signal = vectors * values.clamp_min(0) @ vectors.mT
        values, vectors = torch.linalg.eigh(signal + noise)
        kept = values > 1e-9 * values[-1].clamp_min(1e-30)
        inverse = vectors * torch.where(kept, 1 / values.clamp_min(1e-30), 0.0) @ vectors.mT
        self.gain.copy_(signal @ inverse)


class LatentActionSmoothed(LatentActionModule):
    r"""Infers latent actions from a lifted and smoothed window, or from the raw one if its held-out error is lower.

    .. math::
        w_t = (g(x_{t-n}), \dots, g(x_t), g(x_{t+2}), \dots, g(x_{t+k})), \quad
        u_t = (\gamma_1\, \phi(A w_t),\; \gamma_2\, \phi(x_{t-4}, \dots, x_{t+5}))

    ``g`` is the lifting to a few coordinates, shared with the Koopman model, ``A`` the gain of a
    :class:`WienerSmoother` and ``phi`` the observables of :class:`LatentActionFourier` (steps and ``num_features``
    random Fourier features). All are fitted to unlabelled windows (:meth:`finish`). One ``gamma`` is 1 and the other 0
    (:meth:`choose`); the held-out error on the labelled steps of the budget decides.

    If the lifting equals the state, the first block holds the smoothed state. The raw block must not read frames beyond
    those of the lifted block. Keywords as for :class:`LatentActionModule`.
    """

    gates: Tensor
    spread: Tensor
    blocks = (LIFTED, RAW)
    min_trajectories = 0  # RAW_SHARE is strict enough for few labels

    def __init__(
        self,
        lifting: KoopmanLifting | CompactLifting,
        num_features: int,
        *,
        num_past: int = 8,
        look_ahead: int | Sequence[int] = (2, 3, 4, 5, 6, 7, 8),
        **kwargs,
    ):
        dim = lifting.latent_dim
        frames: dict[str, Any] = {"num_past": num_past, "look_ahead": look_ahead}
        raw_frames: dict[str, Any] = {"num_past": RAW_PAST, "look_ahead": RAW_LOOK_AHEAD}
        # random features are not trained: training them had no measurable effect
        lifted = LatentActionFourier(dim, num_features, trainable=False, **frames)
        ahead = lifted.reader.look_ahead[-1]
        if RAW_PAST > num_past or max(RAW_LOOK_AHEAD) > ahead:
            raise ValueError(
                f"the raw block reads {RAW_PAST} frames back and {max(RAW_LOOK_AHEAD)} ahead: the lifted one must read"
                f" as many, got {num_past} and {ahead}"
            )
        raw = LatentActionFourier(lifting.state_dim, num_features, trainable=False, **raw_frames)
        super().__init__(lifting.state_dim, lifted.latent_dim + raw.latent_dim, **frames, **kwargs)
        # reads the lifted frames that are smoothed together
        self.reader = WindowReader(dim, relative=False, clamped=self.reader.clamped, **frames)
        self.keeps_state = lifting.keeps_state
        self.lifted, self.raw = lifted, raw
        self._lifting = (lifting,)  # the tuple prevents registration: the Koopman model owns its weights
        self.smoother = WienerSmoother(self.reader.num_frames, dim)
        self.register_buffer("spread", torch.ones(dim))
        self.register_buffer("gates", torch.tensor([1.0, 0.0]))

    def best_block(self, errors: Mapping[str, float]) -> str:
        """Returns the raw block if its held-out error is below 85 % of the lifted one's, else the lifted one."""
        return min(errors, key=lambda block: errors[block] / (RAW_SHARE if block == RAW else 1.0))

    @torch.no_grad()
    def choose(self, block: str) -> None:
        """Selects one block; the entries of the other become 0."""
        self.gates.copy_(torch.tensor([float(block == LIFTED), float(block == RAW)]))

    @property
    def chosen(self) -> str:
        """Name of the selected block."""
        return RAW if self.gates[1] else LIFTED

    def _lift(self, state: Tensor) -> Tensor:
        return self._lifting[0].encode(state) / self.spread

    def gather(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Reads smoothed steps and present frame, then the raw ones, flattened: ``[*B, T, 1, F m + 9 d]``."""
        smoothed = self.smoother(self.reader.gather(self._lift(state), frames))
        lifted = self.reader.steps(smoothed) / self.lifted.reader.scales
        return torch.cat([lifted.flatten(-2), self.raw.gather(state, frames).flatten(-2)], -1).unsqueeze(-2)

    def infer(self, read: Tensor) -> Tensor:
        """Evaluates the observables of both blocks ``[*B, T, m]``; those of the one not chosen are 0."""
        networks, frames = (self.lifted, self.raw), read.squeeze(-2).tensor_split((self.reader.num_features,), -1)
        parts = [net.infer(own.unflatten(-1, (-1, net.state_dim))) for net, own in zip(networks, frames, strict=True)]
        return torch.cat([gate * part for gate, part in zip(self.gates, parts, strict=True)], -1)

    def prepare(self, windows: Tensor) -> None:
        """Fits as :meth:`finish` does, with the lifting before training."""
        self.finish(windows)

    @torch.no_grad()
    def finish(self, windows: Tensor) -> None:
        """Fits to windows ``[*B, T, d]`` all that depends on the lifting: spread, smoother and spread of the steps."""
        windows = windows.reshape(-1, *windows.shape[-2:])
        now = self.reader.valid_frames(windows.shape[-2])[:1]
        self.spread.fill_(1.0)
        lifted = torch.cat([self._lift(part) for part in windows.split(BATCH)])
        spread = lifted.flatten(0, 1).std(0)
        self.spread.copy_(torch.where(spread > 1e-9, spread, 1.0))
        lifted = lifted / self.spread
        read = self.reader.gather(lifted, now).squeeze(-3)
        self.smoother.fit(read, lifted)
        steps = self.reader.steps(self.smoother(read)).square().mean(0).sqrt()
        moving = spread > 1e-9
        # a lifting may set coordinates to 0: the rescaling gives the others the weight that they would have alone
        steps = steps * (moving.sum() / moving.numel()).clamp_min(1e-9).sqrt()
        self.lifted.reader.set_spread(steps)
        self.raw.reader.fit(windows)

    def axis_features(self, axes: Sequence[int]) -> tuple[Tensor, Tensor] | None:
        """Returns the steps' entries in the chosen block; None if that is lifted and does not keep the state."""
        if self.chosen == RAW:
            entries, factors = self.raw.axis_features(axes)
            return entries + self.lifted.latent_dim, factors
        if not self.keeps_state:
            return None
        entries, factors = self.lifted.axis_features(axes)
        return entries, factors * self.spread[list(axes)]
