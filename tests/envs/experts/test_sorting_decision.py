# This source code is licensed under the MIT license found in the LICENSE file.
"""What it costs to lead a box to its bin: more where others are in the way, and not that it is itself there."""

import numpy as np
import pytest

from torchrl_koap.envs.experts.sorting_decision import (
    FAR,
    ORIGIN,
    SHAPE,
    STEP,
    best_push,
    descent,
    solve_eikonal,
    square_distance,
    value_at,
)
from torchrl_koap.tasks.sorting import BIN_X

LANE = BIN_X[0]
ROD = np.array([LANE, -0.25])


def cost(*boxes):
    """Of leading the first box to the first bin."""
    boxes = np.array(boxes)
    return best_push(boxes, np.zeros(len(boxes)), np.ones(len(boxes), dtype=bool), 0, LANE, ROD)[-1]


def test_a_box_in_front_of_its_bin_costs_about_the_way():
    edge = 0.236  # m, where the bin begins
    for y in (0.05, -0.10):
        assert cost((LANE, y)) == pytest.approx(edge - y, abs=0.06)


def test_a_box_in_the_way_costs_a_detour():
    free, blocked = cost((LANE, -0.10), (LANE + 0.15, -0.10)), cost((LANE, -0.10), (LANE, 0.05))
    assert blocked > free + 0.01


def test_distance_to_a_turned_square():
    square = np.array([0.4, 0.1, np.cos(np.pi / 4), np.sin(np.pi / 4)])
    assert square_distance(0.4, 0.1, square, 0.03) == pytest.approx(-0.03)
    assert square_distance(0.4 + 0.03 * 2**0.5 + 0.02, 0.1, square, 0.03) == pytest.approx(0.02)
    assert square_distance(0.4 + 0.1, 0.1 + 0.1, square, 0.03) == pytest.approx(0.1 * 2**0.5 - 0.03)


def source(i, j):
    cost = np.full(SHAPE, FAR)
    cost[i, j] = 0.0
    return cost


def test_costs_are_distances_where_slowness_is_one():
    cost = solve_eikonal(np.ones(SHAPE), source(40, 40))
    i, j = np.indices(SHAPE)
    distance = STEP * np.hypot(i - 40, j - 40)
    assert np.abs(cost - distance).max() < 0.03  # first order: some STEP too long along diagonals
    assert (cost >= distance - 1e-12).all()
    x, y = ORIGIN[0] + 60 * STEP, ORIGIN[1] + 40 * STEP
    np.testing.assert_allclose(descent(cost, x, y), (-1, 0), atol=1e-6)


def test_a_wall_is_gone_round():
    slowness = np.ones(SHAPE)
    slowness[30:32, :60] = 50.0
    cost = solve_eikonal(slowness, source(20, 30))
    around = STEP * (np.hypot(10, 30) + np.hypot(12, 30))
    assert around < cost[42, 30] < around + 0.04
    direction = descent(cost, ORIGIN[0] + 42 * STEP, ORIGIN[1] + 30 * STEP)
    assert direction[1] > 0.8  # up, to the end of the wall


def test_undefined_places_have_undefined_values():
    assert np.isnan(value_at(np.ones(SHAPE), np.nan, 0.0)) and np.isnan(value_at(np.ones(SHAPE), 0.4, np.nan))
    assert value_at(np.ones(SHAPE), 1e9, -1e9) == pytest.approx(1.0)
