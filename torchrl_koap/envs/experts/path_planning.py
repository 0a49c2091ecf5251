# This source code is licensed under the MIT license found in the LICENSE file.
"""Eikonal path planning in the plane: least cost of a path through a field of slowness, and distances to squares.

The cost ``T(p)`` of the cheapest path from ``p`` to a source obeys the eikonal equation ``|grad T| = s`` with slowness
``s`` (cost per metre), solved on a grid by fast sweeping (Zhao 2005): Gauss-Seidel passes in alternating directions.

Compiled callers in other files are cached by Numba without regard to this file: clear ``__pycache__`` after a change.
"""

from __future__ import annotations

import numpy as np
from numba import njit

STEP = 0.008  # m between neighbouring grid points
ORIGIN = (0.14, -0.4)  # x, y of the first one (m)
SHAPE = (91, 90)  # points along x and y
FAR = 1e3  # cost of a place that is not reached


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
def solve_eikonal(slowness, cost, sweeps=2):
    """Solves for the cheapest cost to the sources, everywhere on the grid.

    Args:
        slowness (np.ndarray): cost per metre [X, Y], positive.
        cost (np.ndarray): [X, Y]: cost at the sources, :data:`FAR` elsewhere; overwritten and returned.
        sweeps (int): rounds of four passes.
    """
    width, height = cost.shape
    for sweep in range(4 * sweeps):
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
    """Interpolates a field [X, Y] at ``x, y`` (m): bilinear, constant beyond the border, NaN where they are."""
    if np.isnan(x + y):
        return np.nan
    u = min(max((x - ORIGIN[0]) / STEP, 0.0), field.shape[0] - 1.001)
    v = min(max((y - ORIGIN[1]) / STEP, 0.0), field.shape[1] - 1.001)
    i, j = int(u), int(v)
    u, v = u - i, v - j
    low = (1 - v) * field[i, j] + v * field[i, j + 1]
    high = (1 - v) * field[i + 1, j] + v * field[i + 1, j + 1]
    return (1 - u) * low + u * high


@njit(cache=True)
def descent(field, x, y, reach=0.016, softness=0.002):
    """Finds the direction, a unit vector [2], in which a field is least at a distance from a point.

    Values within about ``softness`` of the least one count too, which smooths the direction; a mere gradient would
    shiver between the walls of narrow passages.

    Args:
        field (np.ndarray): values on the grid [X, Y].
        x, y (float): the point (m).
        reach (float): the distance (m).
        softness (float): how much above the least one a value still counts, in the unit of the field.
    """
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
