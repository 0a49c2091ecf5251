# This source code is licensed under the MIT license found in the LICENSE file.
"""Scripted expert of Sorting: pushes the boxes into their bins in any order of colours.

It decides anew at every control step and has little memory, so similar situations give similar motions. In one
control step it

    1. chooses a box    of the next colour, and keeps it until it has arrived
    2. chooses a way    to push: the direction that is best for the way of the box to the bin, past the other boxes, and
                        for the way of the rod to the place behind the box
    3. moves the rod    around all boxes to that place, or, once behind the box, forwards; while pushing it turns
                        by 1.4 times the angle between push and box, which brings the box back in front of it

The last two are in :mod:`torchrl_koap.envs.experts.sorting_decision`.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from torchrl_koap.envs.experts.recording import Expert, ar1_noise
from torchrl_koap.envs.experts.sorting_decision import best_push, decide
from torchrl_koap.tasks.sorting import BIN_HALF, BIN_X, arrival_orders, box_colours, sorting_task

ARRIVED_Y = 0.232  # m; beyond, a box has left the platform
_HORIZON = 700  # control steps for which hand noise is drawn
_LINGER = 4  # control steps after success
_STICK = 0.0118  # m per control step and axis, the largest of humans
# The arm is compliant: the rod oscillates around the command by centimetres, with a period of 26 control steps. These
# gains on the speed error and on the distance of rod and command damp it.
_DAMPING = np.array([0.3, 0.5])
_LEAK = 0.18
_LATENCY = 2.0  # control steps between an observation and the first effect of the action


class SortingExpert(Expert):
    """Scripted expert of Sorting; modes are orders of colours (``arrival_orders``).

    It has finished when it has had nothing to do for a few control steps.
    """

    most_rows = 699

    def __init__(self, modes: Sequence[int], contexts: np.ndarray, seeds: Sequence):
        num_boxes = np.shape(contexts)[1]
        self.TASK = sorting_task(num_boxes).name
        super().__init__(modes, contexts, seeds)
        self._colours = np.array(box_colours(num_boxes))
        self._orders = np.array(arrival_orders(num_boxes))[list(modes)]
        drawn = [_draw(np.random.default_rng(seed), num_boxes) for seed in seeds]
        self._habits = SimpleNamespace(**{name: np.stack([each[name] for each in drawn]) for name in drawn[0]})
        count = len(modes)
        self._time = 0
        self._arrived = np.zeros((count, num_boxes), dtype=bool)
        self._lost = np.zeros((count, num_boxes), dtype=bool)
        self._target = np.full(count, -1)
        self._pushing = np.zeros(count, dtype=bool)
        self._direction = np.full(count, np.nan)  # of pushing (rad)
        self._rest = np.zeros(count, dtype=np.int64)  # control steps without anything to do
        self._wish = np.zeros((count, 2))  # wanted speed of the rod (m per control step)
        self._speed = np.zeros((count, 2))  # its measured speed
        self._seen = None

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns changes of the commanded xy [n, 2] (m) for observations [n, 4 + 3 num_boxes]."""
        boxes = observation[:, 4:].reshape(len(observation), -1, 3)
        self._look(boxes[..., :2])
        rod = observation[:, 2:4].copy()
        self._speed = np.zeros_like(rod) if self._seen is None else rod - self._seen
        self._seen = rod
        decision = np.zeros_like(rod)
        for row in np.flatnonzero(self._rest == 0):
            decision[row] = self._play(row, observation[row], boxes[row])
        tempo = self._habits.tempo[:, self._time % _HORIZON] * (self._time >= self._habits.pause)
        self._wish += 0.4 * (decision * tempo[:, None] - self._wish)
        self._time += 1
        stretch = observation[:, 2:4] - observation[:, :2]
        return np.clip(self._wish + _DAMPING * (self._wish - self._speed) + _LEAK * stretch, -_STICK, _STICK)

    def _look(self, places: np.ndarray) -> None:
        """Notes which boxes have arrived in their bins, and which fell beside them."""
        off = np.abs(places[..., 0] - np.take(BIN_X, self._colours))
        over = places[..., 1] > ARRIVED_Y
        self._arrived |= over & (off < BIN_HALF)
        beside = (places[..., 1] > ARRIVED_Y + 0.02) | (np.abs(places[..., 0] - 0.5) > 0.3)
        self._lost |= beside & ~self._arrived
        done = self._arrived.all(1) | self._lost.any(1)
        self._rest = np.where(done, self._rest + 1, 0)
        self.finished = self._rest > _LINGER

    def _play(self, row: int, observation: np.ndarray, boxes: np.ndarray) -> tuple[float, float]:
        present = ~self._arrived[row] & ~self._lost[row]
        places, yaws = np.ascontiguousarray(boxes[:, :2]), np.arctan(boxes[:, 2])
        rod = observation[2:4].copy()
        ahead = rod + _LATENCY * self._speed[row]
        if self._target[row] < 0 or not present[self._target[row]]:
            self._target[row] = self._choose_box(row, places, yaws, present, ahead)
            self._pushing[row], self._direction[row] = False, np.nan
        target = int(self._target[row])
        lane = BIN_X[self._colours[target]] + self._habits.aim[row, target]
        mind = bool(self._pushing[row]), float(self._direction[row])
        x, y, *mind = decide(places, yaws, present, target, lane, rod, ahead, *mind)
        self._pushing[row], self._direction[row] = mind
        return x, y

    def _choose_box(self, row: int, places, yaws, present, rod) -> int:
        wanted = self._orders[row, min(int(self._arrived[row].sum()), len(self._colours) - 1)]
        candidates = np.flatnonzero(present & (self._colours == wanted))
        if not len(candidates):
            candidates = np.flatnonzero(present)
        costs = []
        for target in candidates:
            lane = BIN_X[self._colours[target]]
            costs.append(best_push(places, yaws, present, target, lane, rod)[-1])
        return int(candidates[np.argmin(np.array(costs) + self._habits.taste[row, candidates])])


def _draw(generator: np.random.Generator, num_boxes: int) -> dict[str, Any]:
    """Draws the habits of an episode: ``taste`` for boxes (m of way), ``aim`` within the bin (m), pause, tempo."""
    return {
        "taste": generator.normal(0, 0.03, num_boxes),
        "aim": generator.uniform(-0.015, 0.015, num_boxes),
        "pause": generator.integers(0, 6),
        "tempo": generator.uniform(0.95, 1.05) * (1 + ar1_noise(generator, 15, 0.04, _HORIZON)),
    }
