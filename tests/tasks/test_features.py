# This source code is licensed under the MIT license found in the LICENSE file.
"""Angles as points on the unit circle: no jumps, no poles, nothing lost."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.tasks.features import double_yaw, plane, yaw_of


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_double_yaw_is_continuous_and_unit_length(dtype):
    yaw = torch.linspace(-1.5707, 1.5707, 101, dtype=dtype)[:, None]
    found = double_yaw(yaw.tan())
    assert found.dtype == dtype
    expected = torch.cat([(2 * yaw).cos(), (2 * yaw).sin()], -1)
    assert torch.allclose(found, expected, atol=2e-3 if dtype == torch.float32 else 1e-9)
    # both ends of the range are one and the same direction
    assert torch.allclose(found[0], found[-1], atol=1e-3)


def test_poles_of_the_tangent_are_finite():
    found = double_yaw(torch.tensor([[math.inf], [-math.inf], [1e30]]))
    assert torch.allclose(found, torch.tensor([[-1.0, 0.0]]).expand(3, 2), atol=1e-6)


def test_gradients_of_features_are_finite():
    tangent = torch.tensor([[0.0], [3.0], [1e4]], requires_grad=True)
    double_yaw(tangent).sum().backward()
    assert tangent.grad.isfinite().all()


def test_yaw_of_quaternions_ignores_sign_and_a_small_tilt():
    yaw = torch.linspace(-3.1, 3.1, 25, dtype=torch.float64)
    zero = torch.zeros_like(yaw)
    upright = torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], -1)
    expected = torch.stack([yaw.cos(), yaw.sin()], -1)
    assert torch.allclose(yaw_of(upright), expected) and torch.allclose(yaw_of(-upright), expected)
    tilt = torch.tensor([math.cos(0.02), math.sin(0.02), 0.0, 0.0], dtype=torch.float64)  # 2.3 deg about x, first
    w, _, _, z = upright.unbind(-1)
    tilted = torch.stack([w * tilt[0], w * tilt[1], z * tilt[1], z * tilt[0]], -1)
    assert (yaw_of(tilted) - expected).abs().max() < 2e-3


def test_plane_drops_the_height():
    assert plane(torch.tensor([1.0, 2.0, 3.0])).tolist() == [1.0, 2.0]
