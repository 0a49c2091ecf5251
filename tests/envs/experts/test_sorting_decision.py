# This source code is licensed under the MIT license found in the LICENSE file.
"""What it costs to lead a box to its bin: more where others are in the way, and not that it is itself there."""

import numpy as np
import pytest

from torchrl_koap.envs.experts.sorting_decision import pushing_cost
from torchrl_koap.tasks.sorting import BIN_X

LANE = BIN_X[0]
ROD = np.array([LANE, -0.25])


def cost(*boxes):
    """Of leading the first box to the first bin."""
    boxes = np.array(boxes)
    return pushing_cost(boxes, np.zeros(len(boxes)), np.ones(len(boxes), dtype=bool), 0, LANE, ROD)


def test_a_box_in_front_of_its_bin_costs_about_the_way():
    edge = 0.236  # m, where the bin begins
    for y in (0.05, -0.10):
        assert cost((LANE, y)) == pytest.approx(edge - y, abs=0.06)


def test_a_box_in_the_way_costs_a_detour():
    free, blocked = cost((LANE, -0.10), (LANE + 0.15, -0.10)), cost((LANE, -0.10), (LANE, 0.05))
    assert blocked > free + 0.01
