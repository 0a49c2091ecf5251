# This source code is licensed under the MIT license found in the LICENSE file.
"""Scripted expert of Sorting: pushes the boxes into their bins in any order of colours.

It looks at the boxes anew at every control step and keeps hardly anything in mind, so similar situations give similar
motions. In one control step it

    1. chooses a box    of the colour that is next, and stays with it until it has arrived
    2. chooses a way    to push: the direction that brings the box best on its way to the bin, past the other boxes,
                        against the rod's own way to the place behind the box
    3. moves the rod    around all boxes to that place, or, once behind the box, forwards; while pushing it steers
                        twice as far to the side as the box lies off, which brings the box back in front of it

Ways are paths of least cost by the eikonal equation (:mod:`torchrl_koap.envs.experts.path_planning`): for the box with
the others as obstacles, for the rod with all boxes as obstacles. All randomness of an episode comes from its own seed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from torchrl_koap.envs.experts.noise import ar1_noise
from torchrl_koap.envs.experts.path_planning import (
    FAR,
    ORIGIN,
    SHAPE,
    STEP,
    descent,
    solve_eikonal,
    square_distance,
    value_at,
)
from torchrl_koap.envs.experts.recording import RecordingRules
from torchrl_koap.envs.sorting import box_colours, mode_colours
from torchrl_koap.tasks.sorting import BIN_HALF, BIN_X, BOX_HALF

ROD_RADIUS = 0.01
ARRIVED_Y = 0.232  # m; beyond, a box has left the platform
_LANE_HALF = 0.058  # m; a box is led to within this of the middle of its bin
_HORIZON = 700  # control steps for which the hand's noise is drawn
_LINGER = 4  # control steps after success
_PUSH, _FREE = 0.0130, 0.0145  # m per control step
_STICK = 0.0118  # m per control step and axis, the most that humans used
# The arm is soft: its rod swings around the command with a period of 26 control steps, by centimetres. These gains
# damp it: on the difference of wanted and seen speed, and on the stretch between command and rod.
_DAMPING = np.array([0.3, 0.5])
_LEAK = 0.18
_REACH = 0.30  # m from the base; nearer, the arm may flip over
_LATENCY = 2.0  # control steps from what is seen to when an action begins to show
_DIRECTIONS = 32
_HOLD = 0.006  # a direction is given up for a very different one if that is better by this much (m of way)


@njit(cache=True)
def _squares(boxes, yaws):
    """Centres, cosines and sines of the yaw [n, 4]."""
    squares = np.empty((len(boxes), 4))
    squares[:, :2] = boxes
    squares[:, 2], squares[:, 3] = np.cos(yaws), np.sin(yaws)
    return squares


@njit(cache=True)
def _box_field(boxes, yaws, obstacle, lane):
    """Cost of the rest of a box's way into its bin, everywhere [X, Y]; ``lane`` is the middle of the bin (x)."""
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
    """Cost of the rod's way from a place to everywhere [X, Y]."""
    cost = np.full(SHAPE, FAR)
    i = int(min(max((x - ORIGIN[0]) / STEP, 0.0), SHAPE[0] - 2.0))
    j = int(min(max((y - ORIGIN[1]) / STEP, 0.0), SHAPE[1] - 2.0))
    for a in (i, i + 1):
        for b in (j, j + 1):
            cost[a, b] = np.hypot(x - ORIGIN[0] - a * STEP, y - ORIGIN[1] - b * STEP)
    return solve_eikonal(slowness, cost)


@njit(cache=True)
def _behind(box, yaw, angle, clearance):
    """Place of the rod from which it pushes a box along ``angle``."""
    turned = angle - yaw
    support = BOX_HALF * (abs(np.cos(turned)) + abs(np.sin(turned)))
    # the middle of a face is nearer than the corners that the support counts
    reach = min(support, BOX_HALF / max(abs(np.cos(turned)), abs(np.sin(turned)))) + ROD_RADIUS + clearance
    return box[0] - reach * np.cos(angle), box[1] - reach * np.sin(angle)


@njit(cache=True)
def _carried(box, yaw, rod, ahead):
    """Where a box will be once the rod has come from where it is to the place ``ahead``."""
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
    """What is left to go after pushing along ``angle``, plus the rod's way to the place behind the box."""
    cos, sin = np.cos(angle), np.sin(angle)
    left = 0.5 * (
        value_at(to_go, box[0] + 0.02 * cos, box[1] + 0.02 * sin)
        + value_at(to_go, box[0] + 0.045 * cos, box[1] + 0.045 * sin)
    )
    x, y = _behind(box, yaw, angle, 0.007)
    return left + 0.2 * max(value_at(way, x, y) - 0.03, 0.0) + 0.004 * (value_at(slowness, x, y) - 1)


@njit(cache=True)
def _choose_direction(box, yaw, to_go, way, slowness):
    """Angle along which to push, and its cost."""
    best, best_cost = 0.0, np.inf
    for k in range(_DIRECTIONS):
        angle = 2 * np.pi * k / _DIRECTIONS
        cost = _direction_cost(box, yaw, angle, to_go, way, slowness)
        if cost < best_cost:
            best, best_cost = angle, cost
    return best, best_cost


@njit(cache=True)
def _wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


@njit(cache=True)
def _decide(boxes, yaws, present, target, lane, rod, ahead, pushing, held):
    """Step of the rod [2] (m), whether it pushes, and the direction in which; ``held`` is the last one, or NaN."""
    boxes = boxes.copy()
    boxes[target] = _carried(boxes[target], yaws[target], rod, ahead)
    box, yaw = boxes[target], yaws[target]
    others = present.copy()
    others[target] = False
    to_go = _box_field(boxes, yaws, others, lane)
    slowness = _rod_slowness(boxes, yaws, present, target)
    way = _cost_from(slowness, ahead[0], ahead[1])
    angle, cost = _choose_direction(box, yaw, to_go, way, slowness)
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


class SortingExpert:
    """Scripted expert of Sorting for a batch of episodes, one mode and one seed each.

    Args:
        modes (sequence of int): the order of colours each episode shall take, numbers as
            :func:`~torchrl_koap.envs.sorting.mode_index` gives them.
        contexts (array): contexts of the episodes [n, num_boxes, 3]; only their number is looked at, the player sees
            the boxes themselves.
        seeds (sequence): for each episode a tuple of integers, as for ``numpy.random.default_rng``.

    Keyword Args:
        num_boxes (int): 2, 4 or 6.

    Raises:
        ValueError: if a mode does not exist or the numbers of modes, contexts and seeds differ.

    Examples:
        >>> import torch
        >>> from torchrl_koap.envs import SortingEnv
        >>> from torchrl_koap.envs.contexts import evaluation_contexts
        >>> from torchrl_koap.envs.sorting import mode_index
        >>> from torchrl_koap.envs.experts.sorting import SortingExpert
        >>> contexts = evaluation_contexts("sorting_2", 2)
        >>> env = SortingEnv(2, num_boxes=2, contexts=contexts, dtype=torch.float64)
        >>> expert = SortingExpert([0, 1], contexts, [(1, 0), (1, 1)], num_boxes=2)
        >>> def policy(td):
        ...     return td.set("action", torch.from_numpy(expert.act(td["observation"].numpy())))
        >>> last = env.rollout(300, policy, break_when_any_done=False, break_when_all_done=True)["next"][:, -1]
        >>> last["success"].squeeze(-1).tolist(), mode_index(last["mode"]).tolist()
        ([True, True], [0, 1])
    """

    rules = RecordingRules(most_rows=699)

    # set from _draw
    _taste: np.ndarray
    _aim: np.ndarray
    _pause: np.ndarray
    _tempo: np.ndarray

    def __init__(self, modes: Sequence[int], contexts, seeds: Sequence, *, num_boxes: int = 4):
        modes, seeds, contexts = list(modes), list(seeds), np.asarray(contexts)
        if not modes or len(modes) != len(seeds) or contexts.shape != (len(modes), num_boxes, 3):
            raise ValueError(
                f"as many modes, contexts [{num_boxes}, 3] and seeds are needed, at least one, got {len(modes)} modes,"
                f" contexts of shape {list(contexts.shape)}, {len(seeds)} seeds"
            )
        self._colours = box_colours(num_boxes)
        self._orders = np.array([mode_colours(mode, num_boxes) for mode in modes])
        drawn = [_draw(np.random.default_rng(seed), num_boxes) for seed in seeds]
        for name in drawn[0]:
            setattr(self, f"_{name}", np.stack([habits[name] for habits in drawn]))
        count = len(modes)
        self._time = 0
        self._arrived = np.zeros((count, num_boxes), dtype=bool)
        self._lost = np.zeros((count, num_boxes), dtype=bool)
        self._target = np.full(count, -1)
        self._pushing = np.zeros(count, dtype=bool)
        self._direction = np.full(count, np.nan)  # of pushing (rad)
        self._rest = np.zeros(count, dtype=np.int64)  # control steps without anything to do
        self._wish = np.zeros((count, 2))  # speed the rod shall have (m per control step)
        self._speed = np.zeros((count, 2))  # that it has
        self._seen = None

    @property
    def finished(self) -> np.ndarray:
        """Which players have nothing left to do and would stop recording, a few control steps later, bool [n]."""
        return self._rest > _LINGER

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Decides the next control step of every episode.

        Args:
            observation (array): [n, 4 + 3 num_boxes] as :class:`~torchrl_koap.envs.SortingEnv` gives.

        Returns:
            np.ndarray: change of the commanded xy [n, 2] (m), float64.

        Raises:
            ValueError: if the shape is wrong or something is NaN.
        """
        observation = np.asarray(observation, dtype=np.float64)
        wanted = (len(self._target), 4 + 3 * len(self._colours))
        if observation.shape != wanted:
            raise ValueError(f"observation must have shape {list(wanted)}, got {list(observation.shape)}")
        if np.isnan(observation).any():
            raise ValueError(f"observation must not hold NaN, row {int(np.isnan(observation).any(1).argmax())} does")
        boxes = observation[:, 4:].reshape(len(observation), -1, 3)
        self._look(boxes[..., :2])
        rod = observation[:, 2:4].copy()
        self._speed = np.zeros_like(rod) if self._seen is None else rod - self._seen
        self._seen = rod
        decision = np.zeros_like(rod)
        for row in np.flatnonzero(self._rest == 0):
            decision[row] = self._play(row, observation[row], boxes[row])
        tempo = self._tempo[:, self._time % _HORIZON] * (self._time >= self._pause)
        self._wish += 0.4 * (decision * tempo[:, None] - self._wish)
        self._time += 1
        stretch = observation[:, 2:4] - observation[:, :2]
        return np.clip(self._wish + _DAMPING * (self._wish - self._speed) + _LEAK * stretch, -_STICK, _STICK)

    def _look(self, places: np.ndarray) -> None:
        """Notes which boxes have arrived in their bins, and which fell beside."""
        off = np.abs(places[..., 0] - np.take(BIN_X, self._colours))
        over = places[..., 1] > ARRIVED_Y
        self._arrived |= over & (off < BIN_HALF)
        beside = (places[..., 1] > ARRIVED_Y + 0.02) | (np.abs(places[..., 0] - 0.5) > 0.3)
        self._lost |= beside & ~self._arrived
        done = self._arrived.all(1) | self._lost.any(1)
        self._rest = np.where(done, self._rest + 1, 0)

    def _play(self, row: int, observation: np.ndarray, boxes: np.ndarray) -> tuple[float, float]:
        present = ~self._arrived[row] & ~self._lost[row]
        places, yaws = np.ascontiguousarray(boxes[:, :2]), np.arctan(boxes[:, 2])
        rod = observation[2:4].copy()
        ahead = rod + _LATENCY * self._speed[row]
        if self._target[row] < 0 or not present[self._target[row]]:
            self._target[row] = self._choose_box(row, places, yaws, present, ahead)
            self._pushing[row], self._direction[row] = False, np.nan
        target = int(self._target[row])
        lane = BIN_X[self._colours[target]] + self._aim[row, target]
        mind = bool(self._pushing[row]), float(self._direction[row])
        x, y, *mind = _decide(places, yaws, present, target, lane, rod, ahead, *mind)
        self._pushing[row], self._direction[row] = mind
        return x, y

    def _choose_box(self, row: int, places, yaws, present, rod) -> int:
        wanted = self._orders[row, min(int(self._arrived[row].sum()), len(self._colours) - 1)]
        candidates = np.flatnonzero(present & (self._colours == wanted))
        if not len(candidates):
            candidates = np.flatnonzero(present)
        costs = []
        for target in candidates:
            others = present.copy()
            others[target] = False
            to_go = _box_field(places, yaws, others, BIN_X[self._colours[target]])
            slowness = _rod_slowness(places, yaws, present, target)
            way = _cost_from(slowness, rod[0], rod[1])
            costs.append(_choose_direction(places[target], yaws[target], to_go, way, slowness)[1])
        return int(candidates[np.argmin(np.array(costs) + self._taste[row, candidates])])


def _draw(generator: np.random.Generator, num_boxes: int) -> dict[str, np.ndarray]:
    """What is random about an episode: ``taste`` for boxes (m of way), ``aim`` within the bin (m), pause, tempo."""
    return {
        "taste": generator.normal(0, 0.03, num_boxes),
        "aim": generator.uniform(-0.015, 0.015, num_boxes),
        "pause": np.array(generator.integers(0, 6)),
        "tempo": generator.uniform(0.95, 1.05) * (1 + ar1_noise(generator, 15, 0.04, _HORIZON)),
    }
