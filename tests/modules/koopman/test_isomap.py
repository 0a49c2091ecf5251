# This source code is licensed under the MIT license found in the LICENSE file.
"""Coordinates along curved surfaces, against surfaces that are known."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules.koopman.isomap import isomap


def uniform(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def explained(coordinates, wanted):
    """Share of the variance of what is wanted that a linear map of the coordinates explains."""
    inputs = torch.cat([coordinates, torch.ones(len(coordinates), 1).to(coordinates)], 1)
    left = wanted - inputs @ torch.linalg.lstsq(inputs, wanted).solution
    return 1 - (left.var(0) / wanted.var(0)).max().item()


def roll(count=2000):
    """A sheet rolled up one and a half times, and where on the sheet the points lie."""
    place = uniform(count, 2) * torch.tensor([9.4, 20.0])
    angle = (place[:, 0] + 4.7).double()
    # arc length is about linear in the square of the angle: points are placed by the angle and judged along the arc
    arc = (angle * (1 + angle**2).sqrt() + torch.asinh(angle)) / 2
    points = torch.stack([angle * angle.cos(), place[:, 1].double(), angle * angle.sin()], -1)
    return points, torch.stack([arc, place[:, 1].double()], -1)


def test_a_rolled_sheet_is_laid_flat():
    points, place = roll()
    assert explained(points, place) < 0.5  # no linear map does
    assert explained(isomap(points, 2), place) > 0.98


def test_a_place_behind_many_bumps_is_found():
    place = uniform(800, 1)
    bumps = (-0.5 * ((place - torch.linspace(-0.1, 1.1, 40)) / 0.05) ** 2).exp()
    assert explained(isomap(bumps, 1), place) > 0.98
    values, vectors = torch.linalg.eigh((bumps - bumps.mean(0)).T @ (bumps - bumps.mean(0)))
    assert explained(bumps @ vectors[:, -1:], place) < 0.85  # the first principal component is folded


def test_coordinates_have_unit_spread_the_widest_first_and_what_is_not_there_is_zero():
    points = torch.cat([3 * uniform(400, 1), uniform(400, 1, seed=1), torch.zeros(400, 3)], 1)
    coordinates = isomap(points, 2)
    torch.testing.assert_close(coordinates.std(0, correction=0), torch.ones(2))
    assert explained(coordinates[:, :1], points[:, :1]) > 0.99
    line = isomap(torch.arange(5.0)[:, None], 8)
    assert line.shape == (5, 8) and explained(line[:, :1], torch.arange(5.0)[:, None]) > 0.999
    assert (line[:, 5:] == 0).all()


def test_parts_that_are_far_apart_are_joined():
    points = torch.cat([uniform(100, 2), 50 + uniform(100, 2, seed=1)])
    coordinates = isomap(points, 2, neighbours=4)
    assert coordinates.isfinite().all()
    near, far = coordinates[:100, 0], coordinates[100:, 0]
    assert (near.max() < far.min()) or (far.max() < near.min())


def test_points_that_coincide_and_dtypes():
    points = uniform(50, 3).repeat(4, 1)
    for dtype in (torch.float32, torch.float64):
        coordinates = isomap(points.to(dtype), 2)
        assert coordinates.dtype == dtype and coordinates.isfinite().all()
    assert isomap(torch.ones(30, 3), 2).abs().max() < 1e-9  # all in one place
    with pytest.raises(ValueError, match="at least two points, got 1"):
        isomap(torch.ones(1, 3), 2)
