# This source code is licensed under the MIT license found in the LICENSE file.
r"""Plans for pushing a tray with a rod: where to touch it and how the force must turn on the way.

A slowly pushed body moves as its friction with the table allows. With the limit surface taken as an ellipsoid, a force
of direction :math:`f` at the point :math:`p` of the body (both in the body's frame, unit length) gives the motion

.. math:: \omega = (p \times f) / a^2, \qquad v = f - \omega\, \hat z \times \delta f,

up to a common factor, where :math:`a` (m) says how friction resists turning and :math:`\delta` (m) how far the load
moves ahead because the force acts above the table. A rod that does not slip moves with the touched point, at
:math:`v + \omega\, \hat z \times p`.

A *contact* is a row of eight numbers: ``x, y`` of the touched point, direction of a force through the middle of the
friction cone, half width of the cone (rad), ``x, y`` of the rod's axis, ``a``, ``delta``; lengths in m, all in the
tray's frame. A *plan* ``[4]`` for a contact holds the slant of the force against the middle of its cone at the
beginning, in the middle and at the end of the way (as ``atanh`` of its share of the half width), and the logarithm of
the length of the rod's way (m). ``pose`` and ``target`` are the present and the wanted pose of the tray, ``[3]``: x, y
(m), yaw (rad).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

KNOTS = 3
LENGTH = KNOTS  # column of a plan
PLAN_SIZE = KNOTS + 1
_PIECES = 16
_POSITION_UNIT, _ANGLE_UNIT = 0.004, math.radians(3.0)  # errors at the end of a plan that cost 1
_SLANT_COST = np.array([0.75, 1.0, 1.9])  # late slants cost more: they leave no room for corrections
_BEND_COST, _LENGTH_COST = 0.25, 16.0
_RESIDUALS = 3 + KNOTS + (KNOTS - 1) + 1
_STEEPEST = 2.5
_SHORTEST, _LONGEST = math.log(0.002), math.log(1.2)


@njit(cache=True)
def motion(contact, share):
    """Computes the motion of tray and rod, per metre of the rod's way, in the tray's frame.

    The force is slanted by ``share``, -1 to 1 times the half width of the cone. Returns ``vx, vy`` of the tray's
    centre, its turn (rad/m), ``ux, uy`` of the rod.
    """
    angle = contact[2] + contact[3] * share
    fx, fy = math.cos(angle), math.sin(angle)
    turn = (contact[0] * fy - contact[1] * fx) / (contact[6] * contact[6])
    vx, vy = fx + turn * contact[7] * fy, fy - turn * contact[7] * fx
    ux, uy = vx - turn * contact[1], vy + turn * contact[0]
    way = math.sqrt(ux * ux + uy * uy)
    return vx / way, vy / way, turn / way, ux / way, uy / way


@njit(cache=True)
def arrive(pose, contact, plan):
    """Computes the pose of the tray, x, y (m), yaw (rad), at the end of a plan."""
    x, y, yaw = pose[0], pose[1], pose[2]
    step = math.exp(plan[LENGTH]) / _PIECES
    for piece in range(_PIECES):
        along = (piece + 0.5) / _PIECES * (KNOTS - 1)
        knot = min(int(along), KNOTS - 2)
        slant = plan[knot] + (along - knot) * (plan[knot + 1] - plan[knot])
        vx, vy, turn, _, _ = motion(contact, math.tanh(slant))
        middle = yaw + 0.5 * step * turn
        c, s = math.cos(middle), math.sin(middle)
        x += step * (c * vx - s * vy)
        y += step * (s * vx + c * vy)
        yaw += step * turn
    return x, y, yaw


@njit(cache=True)
def _residuals(pose, target, contact, plan, out):
    x, y, yaw = arrive(pose, contact, plan)
    turn = yaw - target[2]
    turn -= 2 * math.pi * round(turn / (2 * math.pi))
    out[0], out[1], out[2] = (x - target[0]) / _POSITION_UNIT, (y - target[1]) / _POSITION_UNIT, turn / _ANGLE_UNIT
    for k in range(KNOTS):
        out[3 + k] = math.sqrt(_SLANT_COST[k]) * plan[k]
    for k in range(KNOTS - 1):
        out[3 + KNOTS + k] = math.sqrt(_BEND_COST) * (plan[k + 1] - plan[k])
    out[_RESIDUALS - 1] = math.sqrt(_LENGTH_COST) * math.exp(plan[LENGTH])
    cost = 0.0
    for k in range(_RESIDUALS):
        cost += out[k] * out[k]
    return cost


@njit(cache=True)
def improve(pose, target, contact, plan, iterations):
    """Improves a plan in place by damped Gauss-Newton steps, and returns its cost.

    The cost adds squared errors at its end (4 mm and 3 deg cost 1 each), slants, bends and length.
    """
    base, other = np.empty(_RESIDUALS), np.empty(_RESIDUALS)
    jacobian = np.empty((_RESIDUALS, PLAN_SIZE))
    damping = 0.01
    cost = _residuals(pose, target, contact, plan, base)
    for _ in range(iterations):
        for j in range(PLAN_SIZE):
            keep = plan[j]
            plan[j] = keep + 1e-5
            _residuals(pose, target, contact, plan, other)
            plan[j] = keep
            for i in range(_RESIDUALS):
                jacobian[i, j] = (other[i] - base[i]) / 1e-5
        matrix, right = np.zeros((PLAN_SIZE, PLAN_SIZE)), np.zeros(PLAN_SIZE)
        for i in range(_RESIDUALS):
            for j in range(PLAN_SIZE):
                right[j] -= jacobian[i, j] * base[i]
                for k in range(PLAN_SIZE):
                    matrix[j, k] += jacobian[i, j] * jacobian[i, k]
        for j in range(PLAN_SIZE):
            matrix[j, j] += damping * (1.0 + matrix[j, j])
        change = np.linalg.solve(matrix, right)
        trial = plan.copy()
        for j in range(PLAN_SIZE):
            trial[j] += min(max(change[j], -0.5), 0.5)
            low, high = (_SHORTEST, _LONGEST) if j == LENGTH else (-_STEEPEST, _STEEPEST)
            trial[j] = min(max(trial[j], low), high)
        new = _residuals(pose, target, contact, trial, other)
        if new < cost:
            plan[:] = trial
            base[:] = other
            cost, damping = new, max(damping * 0.3, 1e-6)
        else:
            damping *= 5.0
            if damping > 1e6:
                break
    return cost


@njit(cache=True)
def search(pose, target, contact, plan):
    """Searches the best plan for one contact, from 18 first guesses, and writes it into ``plan``; returns its cost."""
    least = 1e300
    distance = max(math.hypot(target[0] - pose[0], target[1] - pose[1]), 0.01)
    guess = np.empty(PLAN_SIZE)
    for first in range(-1, 2):
        for last in range(-1, 2):
            for stretch in (1.0, 1.6):
                for k in range(KNOTS):
                    share = k / (KNOTS - 1)
                    guess[k] = 1.2 * (first * (1 - share) + last * share)
                guess[LENGTH] = math.log(min(distance * stretch, 1.0))
                cost = improve(pose, target, contact, guess, 20)
                if cost < least:
                    least = cost
                    plan[:] = guess
    return least


@njit(cache=True)
def two_pushes(pose, target, contacts, bounds, aim):
    """Looks for a first push after which a second one, from another contact, leads straight to the target.

    The pose between the pushes, within ``bounds`` [4] (least and greatest x, y; m), is written into ``aim`` [3].
    Returns the least cost of both pushes, and the index of the first of ``contacts`` [C, 8].
    """
    least, best = 1e300, 0
    plan = np.empty(PLAN_SIZE)
    for first in range(len(contacts)):
        for slant in (-0.8, 0.0, 0.8):
            for length in (0.05, 0.10, 0.16, 0.24, 0.34):
                plan[:KNOTS] = slant
                plan[LENGTH] = math.log(length)
                between = np.array(arrive(pose, contacts[first], plan))
                if between[0] < bounds[0] or between[0] > bounds[1] or between[1] < bounds[2] or between[1] > bounds[3]:
                    continue
                effort = _LENGTH_COST * length * length
                for k in range(KNOTS):
                    effort += _SLANT_COST[k] * slant * slant
                distance = max(math.hypot(target[0] - between[0], target[1] - between[1]), 0.01)
                for second in range(len(contacts)):
                    if second == first or effort > least:
                        continue
                    plan[:KNOTS] = 0.0
                    plan[LENGTH] = math.log(distance)
                    cost = effort + improve(between, target, contacts[second], plan, 5)
                    if cost < least:
                        least, best = cost, first
                        aim[:] = between
    return least, best
