# This source code is licensed under the MIT license found in the LICENSE file.
"""The smoother of windows: noise is found and taken out, clean windows stay as they are."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules.koopman.smoothing import WienerSmoother, noise_covariance

FRAMES = [-4, -3, -2, -1, 0, 2, 3, 4]


def make_motion(noise, num=1500, frames=12):
    generator = torch.Generator().manual_seed(0)
    phase = 6.28 * torch.rand(num, 1, 2, generator=generator)
    clean = torch.sin(0.25 * torch.arange(frames)[:, None] + phase)
    return clean, clean + noise * torch.randn(clean.shape, generator=generator)


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_the_noise_of_every_column_is_found(noise):
    _, noisy = make_motion(torch.tensor([noise, 2 * noise]))
    found = noise_covariance(noisy)
    assert found.dtype == torch.float64
    assert found.diagonal().tolist() == pytest.approx([noise**2, 4 * noise**2], rel=0.1)
    assert abs(found[0, 1]) < 0.1 * noise**2


def test_smoothing_takes_noise_out_and_leaves_clean_windows():
    index = [4 + frame for frame in FRAMES]
    clean, noisy = make_motion(0.3)
    smoother = WienerSmoother(len(index), 2)
    assert torch.allclose(smoother(noisy[:, index]), noisy[:, index], atol=1e-6)  # before the fit
    smoother.fit(noisy[:, index], noisy)
    error = (smoother(noisy[:, index]) - clean[:, index]).square().mean().sqrt()
    assert error < 0.6 * 0.3
    smoother.fit(clean[:, index], clean)
    assert (smoother(clean[:, index]) - clean[:, index]).abs().max() < 0.02
    assert smoother(clean[:, index][None]).shape == (1, 1500, 8, 2)


def test_wrong_shapes_are_refused():
    smoother = WienerSmoother(12, 2)
    with pytest.raises(ValueError, match=r"windows must be \[N, 12, 2\], got \[5, 11, 2\]"):
        smoother.fit(torch.zeros(5, 11, 2), torch.zeros(5, 11, 2))
    with pytest.raises(ValueError, match=r"T >= 5, d\], got \[5, 4, 2\]"):
        noise_covariance(torch.zeros(5, 4, 2))
