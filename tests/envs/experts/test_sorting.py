# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the scripted expert of Sorting: it sorts the boxes in the requested order."""

import numpy as np
import pytest
from expert_test_base import ContextExpertTestBase, first_attempts

from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.experts.sorting import _STICK, SortingExpert


class TestSortingExpert(ContextExpertTestBase):
    TASK, EXPERT, MODES = "sorting", SortingExpert, (1, 4)
    VARIANTS = {"sorting_2": 0.9, "sorting_6": 0.75}


@pytest.mark.parametrize(("num_boxes", "modes"), [(2, [0, 1]), (4, [0, 2, 5]), (6, [19])])
def test_first_attempts_arrive_in_the_asked_order(num_boxes, modes):
    task = {2: "sorting_2", 4: "sorting", 6: "sorting_6"}[num_boxes]
    found, _ = first_attempts(task, modes, draw_contexts(task, len(modes), 21), [(5, row) for row in range(len(modes))])
    for attempt in found:
        assert not attempt.fault and attempt.steps < 100 * num_boxes + 60
        assert np.abs(attempt.actions).max() <= _STICK + 1e-9


def observation(rod, boxes):
    flat = np.concatenate([np.asarray(boxes, dtype=float), np.zeros((len(boxes), 1))], axis=1).ravel()
    return np.concatenate([rod, rod, flat])[None]


def steady(expert, seen, steps=12):
    for _ in range(steps):
        action = expert.act(seen)
    return action[0]


def test_it_pushes_a_box_that_lies_in_front_of_the_rod():
    contexts = np.zeros((1, 2, 3))
    expert = SortingExpert([0], contexts, [(0,)])
    action = steady(expert, observation((0.4, 0.04), [(0.4, 0.08), (0.62, 0.0)]))
    assert action[1] > 0.006 and abs(action[0]) < 0.003
    beside = SortingExpert([0], contexts, [(0,)])
    action = steady(beside, observation((0.4, 0.15), [(0.4, 0.08), (0.62, 0.0)]))
    assert np.abs(action[0]) > 0.003  # in front of the box: goes round it


def test_it_goes_round_a_box_of_the_other_colour():
    expert = SortingExpert([0], np.zeros((1, 2, 3)), [(0,)])
    rod, path = np.array([0.45, -0.25]), []
    for _ in range(60):
        seen = observation(rod, [(0.42, 0.08), (0.43, -0.1)])
        path.append(rod)
        rod = rod + expert.act(seen)[0]
        if np.linalg.norm(rod - (0.42, 0.08)) < 0.05:
            break
    gap = np.abs(np.array(path) - (0.43, -0.1)).max(1) - 0.03
    assert gap.min() > 0.01  # the radius of the rod
    assert np.linalg.norm(path[-1] - (0.42, 0.08)) < 0.07


def test_it_rests_after_the_last_box_and_after_a_lost_one():
    for places in ([(0.4, 0.3), (0.6, 0.3)], [(0.15, 0.0), (0.6, 0.0)]):
        expert = SortingExpert([0], np.zeros((1, 2, 3)), [(0,)])
        assert not expert.finished.any()
        action = steady(expert, observation((0.5, 0.1), places), 10)
        assert expert.finished.all() and np.abs(action).max() < 1e-4
