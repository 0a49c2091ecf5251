# This source code is licensed under the MIT license found in the LICENSE file.
"""Pushing model and planner: closed forms, symmetry, and plans that arrive."""

import math

import numpy as np
import pytest

from torchrl_koap.envs.experts.push_planning import LENGTH, PLAN_SIZE, arrive, improve, motion, search

ARM = 0.07


def contact(x, y, direction, cone=0.5, arm=ARM, shift=0.0):
    return np.array([x, y, direction, cone, x, y, arm, shift])


def straight(length):
    plan = np.zeros(PLAN_SIZE)
    plan[LENGTH] = math.log(length)
    return plan


def test_a_push_through_the_centre_moves_straight_on():
    assert motion(contact(-0.055, 0.0, 0.0), 0.0) == pytest.approx((1, 0, 0, 1, 0), abs=1e-15)
    assert motion(contact(-0.055, 0.0, 0.0, shift=0.03), 0.0) == pytest.approx((1, 0, 0, 1, 0), abs=1e-15)
    pose = np.array([0.5, -0.2, 0.7])
    x, y, yaw = arrive(pose, contact(-0.055, 0.0, 0.0), straight(0.3))
    assert (x, y, yaw) == pytest.approx((0.5 + 0.3 * math.cos(0.7), -0.2 + 0.3 * math.sin(0.7), 0.7))


@pytest.mark.parametrize("shift", [0.0, 0.02])
def test_rod_and_touched_point_move_together(shift):
    for offset in (-0.03, 0.01, 0.03):
        for share in (-1.0, -0.3, 0.6):
            touched = contact(-0.055, offset, 0.0, shift=shift)
            vx, vy, turn, ux, uy = motion(touched, share)
            assert math.hypot(ux, uy) == pytest.approx(1)
            assert (ux, uy) == pytest.approx((vx - turn * offset, vy + turn * -0.055))


def test_an_off_centre_push_turns_about_the_point_that_theory_names():
    """A force at distance ``b`` from the centre turns the body about the point at ``a^2 / b`` on the other side."""
    vx, vy, turn, _, _ = motion(contact(-0.055, 0.03, 0.0), 0.0)
    assert turn < 0 and vy == 0
    assert vx / -turn == pytest.approx(ARM**2 / 0.03)
    x, y, yaw = arrive(np.zeros(3), contact(-0.055, 0.03, 0.0), straight(0.2))
    radius, angle = ARM**2 / 0.03, 0.2 * turn
    assert yaw == pytest.approx(angle)
    assert x == pytest.approx(radius * math.sin(-angle), rel=0.01)
    assert y == pytest.approx(-radius * (1 - math.cos(angle)), rel=0.01)


@pytest.mark.parametrize("target", [(0.5, 0.3, 0.0), (0.42, 0.25, 0.9), (0.6, 0.2, -1.2)])
def test_a_found_plan_arrives(target):
    pose, target = np.array([0.5, -0.2, 0.1]), np.array(target)
    corners = [contact(0.035 * x, 0.035 * y, math.atan2(y, x), 1.2) for x in (1, -1) for y in (1, -1)]
    plans = np.empty((4, PLAN_SIZE))
    costs = [search(pose, target, corner, plan) for corner, plan in zip(corners, plans, strict=True)]
    best = int(np.argmin(costs))
    x, y, yaw = arrive(pose, corners[best], plans[best])
    assert math.hypot(x - target[0], y - target[1]) < 0.006
    assert abs((yaw - target[2] + math.pi) % (2 * math.pi) - math.pi) < math.radians(4)
    assert 0.4 < math.exp(plans[best, LENGTH]) < 1.0


def test_improving_never_costs_more_and_follows_a_moved_target():
    touched, pose = contact(-0.055, 0.0, 0.0), np.zeros(3)
    plan = straight(0.2)
    costs = [improve(pose, np.array([0.3, 0.05, 0.2]), touched, plan, 1) for _ in range(12)]
    assert all(later <= earlier + 1e-12 for earlier, later in zip(costs, costs[1:], strict=False))
    assert costs[-1] < 0.2 * costs[0]
    moved = plan.copy()
    improve(pose, np.array([0.32, 0.05, 0.2]), touched, moved, 10)
    assert arrive(pose, touched, moved)[0] - arrive(pose, touched, plan)[0] == pytest.approx(0.02, abs=0.004)
