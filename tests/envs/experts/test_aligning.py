# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the scripted expert of Aligning: success in the requested mode, smooth motion."""

import math

import numpy as np
from expert_test_base import ContextExpertTestBase, first_attempts

from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.experts.aligning import FULL_PUSH, SURGE, AligningExpert


class TestAligningExpert(ContextExpertTestBase):
    TASK, EXPERT = "aligning", AligningExpert


def test_most_first_attempts_succeed_in_the_asked_mode():
    found, _ = first_attempts("aligning", [0, 1] * 3, draw_contexts("aligning", 6, 3), [(5, row) for row in range(6)])
    good = [attempt for attempt in found if not attempt.fault]
    assert len(good) >= 5 and 80 < np.median([attempt.steps for attempt in good]) < 250
    for attempt in good:
        tilt = 2 * np.arcsin(np.minimum(np.linalg.norm(attempt.frames[:, 10:12], axis=-1), 1))
        assert np.degrees(tilt).max() < 10
        assert np.abs(attempt.actions).max() < 1.03 * FULL_PUSH + 0.0015  # what a hand's wobble adds
        assert np.abs(np.diff(attempt.actions, axis=0)).max() < SURGE + 0.0015


def observed(tray, tcp, target=(0.5, 0.3, 0.0)):
    def pose(x, y, yaw, z):
        return [x, y, z, math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]

    return np.array([[*tcp, *tcp, *pose(*tray, -0.0091), *pose(*target, 0.0)]])


def test_it_stops_when_the_tray_is_at_the_target():
    expert = AligningExpert([0], np.array([[(0.5, -0.2, 0.0), (0.5, 0.3, 0.0)]]), [0])
    for _ in range(12):
        moving = expert.act(observed((0.5, -0.2, 0.0), (0.525, -0.35, 0.25)))
    assert np.abs(moving).max() > 0.005 and not expert.finished.any()
    steps = 0
    while not expert.finished.all():
        last = expert.act(observed((0.51, 0.29, math.radians(8)), (0.5, 0.3, 0.15)))
        steps += 1
        assert steps < 12
    assert steps >= 3 and np.abs(last).max() < 0.0025
