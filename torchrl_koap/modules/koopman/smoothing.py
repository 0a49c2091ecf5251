# This source code is licensed under the MIT license found in the LICENSE file.
"""The smoother of noisy windows: the motion that their covariance holds beside white noise, found without labels."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class WienerSmoother(nn.Module):
    r"""Estimates the noise-free frames of a window from all of its frames (a Wiener smoother in closed form).

    .. math::
        \hat w = S (S + N)^{-1} w, \qquad S = \operatorname{cov}(w) - N, \qquad N = (I - \tfrac{1}{F} 1 1^T) \otimes R

    with the ``F`` frames of a window, their mean subtracted, in ``w`` and the covariance ``R`` of white measurement
    noise. Noise that is independent from frame to frame makes neighbouring steps undo each other: where the motion's
    own autocovariance is smooth in the lag, ``R`` is how far the one of lag 1 lies below the curve through those of
    lags 2 and 3 (:func:`noise_covariance`). Without noise ``R`` is 0 and the window stays as it is.

    Args:
        num_frames (int): frames ``F`` of a window.
        dim (int): columns of a frame.
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
        """Fits the gain to windows ``[N, F, dim]`` of the frames that are smoothed together; no label is read.

        The noise is that of ``consecutive`` frames one control step apart, ``[N, T, dim]`` with ``T >= 5``.
        """
        if windows.shape[-2:] != (self.num_frames, self.dim):
            raise ValueError(f"windows must be [N, {self.num_frames}, {self.dim}], got {list(windows.shape)}")
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


def noise_covariance(windows: Tensor) -> Tensor:
    r"""Computes the covariance of white measurement noise from the autocovariances of steps at lags 1, 2 and 3.

    With steps :math:`v_t = x_{t+1} - x_t` of a smooth motion plus noise of covariance ``R``, noise adds ``2 R`` at lag
    0 and ``-R`` at lag 1. A parabola in the lag through lags 2 and 3 says what the motion alone has at lag 1. Windows
    are ``[N, T, d]`` with ``T >= 5``; the result ``[d, d]`` is symmetric and positive semidefinite, float64.
    """
    if windows.ndim != 3 or windows.shape[-2] < 5:
        raise ValueError(f"noise_covariance needs windows [N, T >= 5, d], got {list(windows.shape)}")
    steps = windows.diff(dim=-2).double()
    lagged = []
    for lag in (1, 2, 3):
        early, late = steps[:, :-lag].flatten(0, 1), steps[:, lag:].flatten(0, 1)
        product = early.mT @ late / len(early)
        lagged.append((product + product.mT) / 2)
    curve = (lagged[1] - lagged[2]) / 5  # of a - b l^2
    noise = lagged[1] + 3 * curve - lagged[0]
    values, vectors = torch.linalg.eigh(noise)
    return vectors * values.clamp_min(0) @ vectors.mT
