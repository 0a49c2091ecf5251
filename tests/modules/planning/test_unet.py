# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the U-Net: any horizon, padding, conditions with edges, impossible sizes."""

import pytest
import torch

from torchrl_koap.modules import TemporalUnet


def inputs(batch, horizon=14):
    return torch.randn(batch, horizon, 3), 50 * torch.rand(batch), torch.randn(batch, 6)


@pytest.mark.parametrize("horizon", [1, 7, 8, 13, 14, 40])
@pytest.mark.parametrize("channels", [(16,), (16, 32), (16, 16, 32)])
def test_unet_takes_any_horizon(horizon, channels):
    unet = TemporalUnet(3, 6, channels=channels)
    x, time, condition = inputs(2, horizon=horizon)
    assert unet(x, time, condition).shape == x.shape


def test_unet_pads_by_repeating_the_last_step():
    unet = TemporalUnet(3, 6, channels=(16, 32))
    x, time, condition = inputs(2)
    padded = torch.cat([x, x[:, -1:].expand(2, 2, 3)], 1)
    torch.testing.assert_close(unet(x, time, condition), unet(padded, time, condition)[:, :14])


def test_impossible_channels_are_explained():
    with pytest.raises(ValueError, match=r"channels must be multiples of 8, got \(30,\)"):
        TemporalUnet(3, 6, channels=(30,))
