# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the scripted expert of Avoiding: it takes the requested mode and stops behind the finish line."""

import numpy as np
import pytest
from expert_test_base import ExpertTestBase, first_attempts

from torchrl_koap.envs.experts import avoiding
from torchrl_koap.envs.experts.avoiding import FULL_PUSH, AvoidingExpert, mode_gaps


class TestAvoidingExpert(ExpertTestBase):
    TASK, EXPERT, MODES, TOLERANCE = "avoiding", AvoidingExpert, (20, 7), 1e-12


def test_mode_gaps_count_like_the_environment():
    assert [12 * row1 + 4 * row2 + row3 for row1, row2, row3 in map(mode_gaps, range(24))] == list(range(24))


def test_clearance_is_that_of_the_measured_rod():
    frames = np.array([[0.5, -0.1, 0.5, -0.2], [0.5, -0.1, 0.5, -0.16]])
    assert AvoidingExpert.clearance(frames) == pytest.approx(0.06 - 0.03 - 0.01)


def test_most_first_attempts_take_the_asked_mode():
    found, _ = first_attempts("avoiding", list(range(24)) * 2, None, [(11, index) for index in range(48)])
    assert sum(not attempt.fault for attempt in found) >= 42


def test_why_attempts_are_discarded(monkeypatch):
    ((whole,), _) = first_attempts("avoiding", [1], None, [(11, 1)])
    ((cut,), _) = first_attempts("avoiding", [1], None, [(11, 1)], max_steps=whole.steps - 1)

    draw = avoiding._draw
    with monkeypatch.context() as patch:
        patch.setattr(avoiding, "_draw", lambda mode, generator: draw(1, generator))
        ((other,), _) = first_attempts("avoiding", [2], None, [(11, 1)])

    def give_up(expert, seen):
        expert.finished[:] = True
        return np.zeros((len(seen), 2))

    monkeypatch.setattr(AvoidingExpert, "act", give_up)
    ((left,), _) = first_attempts("avoiding", [1], None, [(11, 1)])
    assert [each.fault for each in (whole, cut, other, left)] == ["", "unfinished", "mode", "unfinished"]


def test_it_lingers_behind_the_line_and_finishes():
    expert = AvoidingExpert([1], None, [0])
    seen = np.array([[0.42, 0.36, 0.42, 0.36]])
    rows = 0
    while not expert.finished.all():
        push = expert.act(seen)
        assert np.abs(push).max() < 1.2 * FULL_PUSH
        rows += 1
        assert rows < 60
    assert rows >= 5
    assert not AvoidingExpert([1], None, [0]).finished.any()
