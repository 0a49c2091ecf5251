# This source code is licensed under the MIT license found in the LICENSE file.
"""Decisions of Sorting's scripted expert in a control step: where to push a box from, and the way of the rod there.

Ways are paths of least cost, for the box with the others as obstacles, for the rod with all boxes as obstacles. The
cost ``T(p)`` of the cheapest path from ``p`` to a source obeys the eikonal equation ``|grad T| = s``. The slowness
``s`` is the cost per metre. It is solved on a grid by fast sweeping (Zhao 2005): Gauss-Seidel passes in alternating
directions. All functions are compiled.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from torchrl_koap.tasks.sorting import BOX_HALF

STEP = 0.008  # m between neighbouring grid points
ORIGIN = (0.14, -0.4)  # x, y of the first one (m)
SHAPE = (91, 90)  # points along x and y
FAR = 1e3  # cost of a place that is not reached
ROD_RADIUS = 0.01
_LANE_HALF = 0.058  # m; largest distance of a box's way from the middle of its bin
_PUSH, _FREE = 0.0130, 0.0145  # m per control step
_REACH = 0.30  # m from the base; nearer, the arm may flip over
_DIRECTIONS = 32
_HOLD = 0.006  # a very different direction must be better by this much (m of way)


@njit(cache=True)
def square_distance(x, y, square, half):
    """Computes the signed distance (m) of the point ``x, y`` (m) to a square; negative inside.

    The square is its centre x, y (m), cosine and sine of its yaw [4], and ``half`` its width (m).
    """
    x, y = x - square[0], y - square[1]
    along = abs(square[2] * x + square[3] * y) - half
    across = abs(square[2] * y - square[3] * x) - half
    if along > 0 and across > 0:
        return np.sqrt(along**2 + across**2)
    return max(along, across)


@njit(cache=True)
def solve_eikonal(slowness, cost):
    """Solves for the cheapest cost to the sources, everywhere on the grid [X, Y], in eight passes.

    ``cost`` holds that of the sources, :data:`FAR` elsewhere, and is overwritten and returned.
    """
    width, height = cost.shape
    for sweep in range(8):
        for i_ in range(width):
            i = i_ if sweep % 2 == 0 else width - 1 - i_
            for j_ in range(height):
                j = j_ if (sweep // 2) % 2 == 0 else height - 1 - j_
                a = min(cost[i - 1, j] if i > 0 else FAR, cost[i + 1, j] if i < width - 1 else FAR)
                b = min(cost[i, j - 1] if j > 0 else FAR, cost[i, j + 1] if j < height - 1 else FAR)
                step = slowness[i, j] * STEP
                if abs(a - b) >= step:
                    new = min(a, b) + step
                else:
                    new = 0.5 * (a + b + np.sqrt(2 * step**2 - (a - b) ** 2))
                if new < cost[i, j]:
                    cost[i, j] = new
    return cost


@njit(cache=True)
def value_at(field, x, y):
    """Interpolates a field [X, Y] at ``x, y`` (m): bilinear, constant beyond the border."""
    u = min(max((x - ORIGIN[0]) / STEP, 0.0), field.shape[0] - 1.001)
    v = min(max((y - ORIGIN[1]) / STEP, 0.0), field.shape[1] - 1.001)
    i, j = int(u), int(v)
    u, v = u - i, v - j
    low = (1 - v) * field[i, j] + v * field[i, j + 1]
    high = (1 - v) * field[i + 1, j] + v * field[i + 1, j + 1]
    return (1 - u) * low + u * high


@njit(cache=True)
def descent(field, x, y):
    """Finds the direction, a unit vector [2], in which a field [X, Y] is least 16 mm from a point.

    Values within about 0.002 of the least one count too, which smooths the direction; a gradient would oscillate
    between the walls of narrow passages.
    """
    reach, softness = 0.016, 0.002
    values = np.empty(32)
    for k in range(32):
        angle = 2 * np.pi * k / 32
        values[k] = value_at(field, x + reach * np.cos(angle), y + reach * np.sin(angle))
    best = np.argmin(values)
    direction = np.zeros(2)
    for turn in range(-7, 8):  # less than 80 deg to both sides, or two opposite ways would cancel
        k = (best + turn) % 32
        weight = np.exp((values[best] - values[k]) / softness)
        direction[0] += weight * np.cos(2 * np.pi * k / 32)
        direction[1] += weight * np.sin(2 * np.pi * k / 32)
    size = np.sqrt(direction[0] ** 2 + direction[1] ** 2)
    return direction / size if size > 1e-9 else direction


@njit(cache=True)
def _squares(boxes, yaws):
    """Centres, cosines and sines of the yaw [n, 4]."""
    squares = np.empty((len(boxes), 4))
    squares[:, :2] = boxes
    squares[:, 2], squares[:, 3] = np.cos(yaws), np.sin(yaws)
    return squares


@njit(cache=True)
def _box_field(boxes, yaws, obstacle, lane):
    """Returns the cost of a box's remaining way into its bin [X, Y]; ``lane`` is the middle of the bin (x)."""
    slowness, cost, squares = np.ones(SHAPE), np.full(SHAPE, FAR), _squares(boxes, yaws)
    for i in range(SHAPE[0]):
        x = ORIGIN[0] + i * STEP
        off = abs(x - lane)
        for j in range(SHAPE[1]):
            y = ORIGIN[1] + j * STEP
            if y > 0.236 and off < _LANE_HALF:
                cost[i, j] = 0.25 * max(off - 0.02, 0.0)
            s = 1.0
            if y > 0.15 and off > _LANE_HALF:
                s += 6.0 * min((y - 0.15) / 0.03, 1.0)
            border = max(_REACH + 0.05 - np.hypot(x, y), x - 0.75, -0.34 - y)
            if border > 0:
                s += 10.0 * min(border / 0.02, 1.0)
            for k in range(len(boxes)):
                if obstacle[k]:
                    gap = square_distance(x, y, squares[k], BOX_HALF)
                    s += 12.0 * min(max((0.048 - gap) / 0.02, 0.0), 1.0)
            slowness[i, j] = s
    return solve_eikonal(slowness, cost)


@njit(cache=True)
def _rod_slowness(boxes, yaws, solid, target):
    slowness, squares = np.ones(SHAPE), _squares(boxes, yaws)
    for i in range(SHAPE[0]):
        x = ORIGIN[0] + i * STEP
        for j in range(SHAPE[1]):
            y = ORIGIN[1] + j * STEP
            border = max(_REACH - np.hypot(x, y), x - 0.82, y - 0.28)
            s = 1.0 + (10.0 * min(border / 0.02, 1.0) if border > 0 else 0.0)
            for k in range(len(boxes)):
                if solid[k]:
                    gap = square_distance(x, y, squares[k], BOX_HALF)
                    margin = 0.016 if k == target else 0.022
                    s += 25.0 * min(max((margin - gap) / 0.012, 0.0), 1.0)
            slowness[i, j] = s
    return slowness


@njit(cache=True)
def _cost_from(slowness, x, y):
    """Returns the cost of the rod's way from a place to everywhere [X, Y]."""
    cost = np.full(SHAPE, FAR)
    i = int(min(max((x - ORIGIN[0]) / STEP, 0.0), SHAPE[0] - 2.0))
    j = int(min(max((y - ORIGIN[1]) / STEP, 0.0), SHAPE[1] - 2.0))
    for a in (i, i + 1):
        for b in (j, j + 1):
            cost[a, b] = np.hypot(x - ORIGIN[0] - a * STEP, y - ORIGIN[1] - b * STEP)
    return solve_eikonal(slowness, cost)


@njit(cache=True)
def _behind(box, yaw, angle, clearance):
    """Returns the place of the rod from which it pushes a box along ``angle``."""
    turned = angle - yaw
    support = BOX_HALF * (abs(np.cos(turned)) + abs(np.sin(turned)))
    # the middle of a face is nearer than the corners that the support counts
    reach = min(support, BOX_HALF / max(abs(np.cos(turned)), abs(np.sin(turned)))) + ROD_RADIUS + clearance
    return box[0] - reach * np.cos(angle), box[1] - reach * np.sin(angle)


@njit(cache=True)
def _carried(box, yaw, rod, ahead):
    """Returns where a box will be when the rod has moved from ``rod`` to ``ahead``."""
    box = box.copy()
    square = np.array([0.0, 0.0, np.cos(yaw), np.sin(yaw)])
    for k in range(1, 5):
        x, y = rod + (ahead - rod) * k / 4
        square[:2] = box
        overlap = ROD_RADIUS - square_distance(x, y, square, BOX_HALF)
        away = box - np.array([x, y])
        size = np.sqrt(away[0] ** 2 + away[1] ** 2)
        if overlap > 0 and size > 1e-6:
            box += away / size * overlap
    return box


@njit(cache=True)
def _direction_cost(box, yaw, angle, to_go, way, slowness):
    """Returns the cost of the box's way after a push along ``angle``, plus that of the rod's way behind the box."""
    cos, sin = np.cos(angle), np.sin(angle)
    left = 0.5 * (
        value_at(to_go, box[0] + 0.02 * cos, box[1] + 0.02 * sin)
        + value_at(to_go, box[0] + 0.045 * cos, box[1] + 0.045 * sin)
    )
    x, y = _behind(box, yaw, angle, 0.007)
    return left + 0.2 * max(value_at(way, x, y) - 0.03, 0.0) + 0.004 * (value_at(slowness, x, y) - 1)


@njit(cache=True)
def best_push(boxes, yaws, present, target, lane, rod):
    """Chooses how to push a box to its bin; arguments are those of :func:`decide`.

    Returns the costs of the box's remaining way and of the rod's way [X, Y], the slowness of the rod [X, Y], the angle
    of the push (rad), and its cost (m of way), which includes the rod's way.
    """
    others = present.copy()
    others[target] = False
    to_go = _box_field(boxes, yaws, others, lane)
    slowness = _rod_slowness(boxes, yaws, present, target)
    way = _cost_from(slowness, rod[0], rod[1])
    best, least = 0.0, np.inf
    for k in range(_DIRECTIONS):
        angle = 2 * np.pi * k / _DIRECTIONS
        cost = _direction_cost(boxes[target], yaws[target], angle, to_go, way, slowness)
        if cost < least:
            best, least = angle, cost
    return to_go, way, slowness, best, least


@njit(cache=True)
def _wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@njit(cache=True)
def decide(boxes, yaws, present, target, lane, rod, ahead, pushing, held):
    """Decides on the step of the rod in x and y (m), whether it pushes, and the direction (rad) in which.

    ``boxes`` [B, 2] are positions (m), ``yaws`` [B] theirs (rad); ``present`` [B] are on the platform. ``target`` is
    the box to push into its bin, whose middle is at x = ``lane`` (m). The rod is at ``rod`` [2] (m), and at ``ahead``
    when the action takes effect. ``pushing`` and the direction ``held`` (rad, or NaN) are those of the last step.
    """
    boxes = boxes.copy()
    boxes[target] = _carried(boxes[target], yaws[target], rod, ahead)
    box, yaw = boxes[target], yaws[target]
    to_go, way, slowness, angle, cost = best_push(boxes, yaws, present, target, lane, ahead)
    change = 0.0 if np.isnan(held) else _wrapped(angle - held)
    if 0.0 < abs(change) <= 0.5:
        angle = held + 0.4 * change
    elif change != 0.0 and _direction_cost(box, yaw, held, to_go, way, slowness) < cost + _HOLD:
        angle = held

    towards = box - ahead
    distance = np.sqrt(towards[0] ** 2 + towards[1] ** 2)
    off = _wrapped(np.arctan2(towards[1], towards[0]) - angle)
    near_x, near_y = _behind(box, yaw, angle, 0.0)
    contact = np.hypot(box[0] - near_x, box[1] - near_y)
    if pushing:
        pushing = abs(off) < 0.8 and distance < contact + 0.04
    else:
        pushing = abs(off) < 0.35 and distance < contact + 0.04
    if pushing:
        heading = angle + min(max(1.4 * off, -1.2), 1.2)
        speed = _PUSH * (1.0 - 0.5 * min(abs(off) / 0.6, 1.0))
        return speed * np.cos(heading), speed * np.sin(heading), True, angle
    x, y = _behind(box, yaw, angle, 0.008)
    gap = np.hypot(x - ahead[0], y - ahead[1])
    if gap < 0.02:
        direction = np.array([x - ahead[0], y - ahead[1]]) / max(gap, 1e-6)
    else:
        direction = descent(_cost_from(slowness, x, y), ahead[0], ahead[1])
    speed = min(_FREE, max(0.45 * gap, 0.005))
    return speed * direction[0], speed * direction[1], False, angle
