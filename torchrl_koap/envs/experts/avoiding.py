# This source code is licensed under the MIT license found in the LICENSE file.
"""Scripted expert of Avoiding: a simulated joystick player that takes any of the 24 ways to the finish line.

The player is modelled after the human demonstrators: pauses, pushes that are held and released, saturation at full
deflection, and a dead zone. In one control step it

    1. looks       at a measured position with a delay, adds its pushes since, and errs by some millimetres
    2. decides     sideways: push towards the gap of the next row, hold, release when there;
                   forwards: at cruising speed, slower or not at all while the gap would come too early;
                   removes whatever would hit a cylinder
    3. moves the   stick, whose deflection follows the decision over about five control steps, with a slowly
       stick       drifting hand
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from torchrl_koap.envs.experts.recording import Expert, ar1_noise
from torchrl_koap.tasks.avoiding import FINISH_Y, OBSTACLES, ROD_RADIUS, ROW_Y

FULL_PUSH = 0.0124  # m per control step at full deflection
LEAST_PUSH = 0.0053  # smaller deflections fall into the dead zone
# x of the gaps that humans take, low and high end, from small to large x (m)
GAPS = (
    ((0.414, 0.446), (0.556, 0.597)),
    ((0.345, 0.376), (0.485, 0.515), (0.626, 0.670)),
    ((0.262, 0.304), (0.412, 0.440), (0.552, 0.588), (0.700, 0.735)),
)
_ROBOT_LAG = 3  # control steps by which the measured position follows the command
_GLANCE = 4  # control steps after which the player sees an event
_MEMORY = 12
_HORIZON = 300  # control steps for which hand noise is drawn


# weights [13] of the last decisions in the deflection; overshoots a little, like a hand
_RING = np.sinc(np.arange(-6, 7) / 3.6) * np.hanning(17)[2:-2]
_HAND = _RING / _RING.sum()
_HAND_REST = 1 - np.cumsum(_HAND)  # share of a decision that remains after each step


def mode_gaps(mode: int) -> tuple[int, int, int]:
    """Returns which gap of each row a mode (0 to 23) takes, counted from small x."""
    return mode // 12, mode % 12 // 4, mode % 4


class AvoidingExpert(Expert):
    """Scripted expert of Avoiding; it has finished when it has released the stick behind the finish line."""

    # the human demonstrations have at most 104 rows and pass the cylinders at 3 mm or more
    TASK, most_rows, least_clearance = "avoiding", 120, 0.003

    def __init__(self, modes: Sequence[int], contexts: None, seeds: Sequence):
        super().__init__(modes, contexts, seeds)
        drawn = [_draw(mode, np.random.default_rng(seed)) for mode, seed in zip(modes, seeds, strict=True)]
        self._habits = SimpleNamespace(**{name: np.stack([each[name] for each in drawn]) for name in drawn[0]})
        count = len(modes)
        self._time = 0
        self._row = np.zeros(count, dtype=np.int64)  # index of the next row; 3 after the last one
        self._forward = self._habits.cruise[:, 0].copy()  # forwards push that is held
        self._blocked = np.zeros(count, dtype=bool)  # a cylinder was straight ahead
        self._side = np.zeros(count)  # sideways push that is held, m per step
        self._crossed = np.full(count, -1)  # time at which the player saw the finish line crossed
        self._decisions = np.zeros((count, len(_HAND), 2))  # latest first
        self._commanded: np.ndarray | None = None
        self._measured: np.ndarray | None = None

    def touching(self, env: Any) -> np.ndarray:
        """Returns which rods touch a cylinder, bool [n]."""
        return env.obstacle_contacts().any(1)

    @staticmethod
    def clearance(frames: np.ndarray) -> float:
        """Returns the least distance of the rod, taken as upright, from any cylinder in a recording ``[T, 4]`` (m)."""
        path = frames[:, 2:]
        gaps = [np.linalg.norm(path - (x, y), axis=1).min() - radius for _, x, y, radius, _ in OBSTACLES]
        return min(gaps) - ROD_RADIUS

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns changes of the commanded xy [n, 2] (m) for observations [n, 4]."""
        seen = self._look(observation)
        decision = self._decide(seen, observation[:, 3])
        self._decisions = np.concatenate([decision[:, None], self._decisions[:, :-1]], axis=1)
        if self._time == 0:  # some players push before the recording starts
            begun = np.arange(len(_HAND)) <= self._habits.head_start[:, None]
            self._decisions = np.where(begun[..., None], decision[:, None], 0.0)
        push = np.einsum("nkd,k->nd", self._decisions, _HAND) + self._habits.tremor[:, self._time % _HORIZON]
        self._time += 1
        self.finished = (self._crossed >= 0) & (self._time >= self._crossed + self._habits.linger)
        return push

    def _look(self, observation: np.ndarray) -> np.ndarray:
        """Estimates where the command would stop if the player released the stick at once, [n, 2]."""
        commanded, measured = observation[:, :2], observation[:, 2:]
        if self._commanded is None:
            self._commanded = np.repeat(commanded[:, None], _MEMORY, axis=1)
            self._measured = np.repeat(measured[:, None], _MEMORY, axis=1)
        self._commanded = np.concatenate([commanded[:, None], self._commanded[:, :-1]], axis=1)
        self._measured = np.concatenate([measured[:, None], self._measured[:, :-1]], axis=1)
        pushed_since = commanded - self._commanded[:, _GLANCE + _ROBOT_LAG]
        surprise = self._measured[:, _GLANCE] + pushed_since - commanded
        to_come = np.einsum("nkd,k->nd", self._decisions, _HAND_REST)
        slip = self._habits.misjudgement[:, self._time % _HORIZON]
        return commanded + to_come + self._habits.attention[:, None] * surprise + slip

    def _decide(self, seen: np.ndarray, height: np.ndarray) -> np.ndarray:
        count = np.arange(len(seen))
        passed = np.array([*ROW_Y, np.inf])[self._row] + self._habits.release[count, self._row]
        self._row += ((seen[:, 1] > passed) | self._may_go_on(seen[:, 0])) & (self._row < 3)
        newly = (height > FINISH_Y) & (self._crossed < 0)
        self._crossed[newly] = self._time

        way = self._habits.gap_x[count, self._row] - seen[:, 0]
        gate = np.array([*ROW_Y, FINISH_Y])[self._row] - self._habits.gate[count, self._row]
        room = np.maximum(gate - seen[:, 1], 0.0)
        cruise = self._habits.cruise[:, self._time % _HORIZON]
        self._push_sideways(way, room / cruise, count)

        steps_sideways = np.abs(way) / FULL_PUSH
        off = np.abs(way) > 2 * self._habits.tolerance[count, self._row]
        late = off & (steps_sideways > room / cruise + self._habits.patience) & (self._row < 3)
        forward = np.where(late, room / np.maximum(steps_sideways, 1e-9), cruise)
        forward = np.where(forward < LEAST_PUSH * self._habits.creep, 0.0, forward)
        self._forward += self._habits.ease * (forward - self._forward)
        forward = np.where(self._forward < 0.3 * LEAST_PUSH, 0.0, self._forward)
        decision = np.stack([self._side * self._habits.grip[:, self._time % _HORIZON], forward], axis=1)
        decision[:, 0] = np.clip(decision[:, 0], -FULL_PUSH, FULL_PUSH)
        decision = self._avoid(seen, decision, cruise)
        behind = (self._crossed >= 0)[:, None]
        decision = np.where(
            behind, np.stack([self._habits.last_side, self._habits.last_forward * cruise], axis=1), decision
        )
        return np.where((self._time < self._habits.pause)[:, None], 0.0, decision)

    def _may_go_on(self, x: np.ndarray) -> np.ndarray:
        """Returns whether the gap is reached and the push may continue, to an open side where the next gap lies."""
        count = np.arange(len(x))
        following = self._habits.gap_x[count, np.minimum(self._row + 1, 3)] - x
        direction = np.sign(self._side)
        reached = (self._habits.gap_x[count, self._row] - x) * direction < 0
        open_side = self._habits.open[count, self._row] == direction
        return reached & open_side & (direction != 0) & (following * direction > 0.02) & (self._row < 2)

    def _push_sideways(self, way: np.ndarray, steps: np.ndarray, count: np.ndarray) -> None:
        """Begins, strengthens and ends the sideways push, given the way to the gap and the steps left until its row."""
        holding = self._side != 0
        there = way * np.sign(self._side) < self._habits.tolerance[count, self._row] * 0.3
        self._side[holding & there] = 0.0
        begin = (self._side == 0) & (
            np.abs(way) > np.where(self._blocked, 0.003, self._habits.tolerance[count, self._row])
        )
        needed = np.abs(way) / np.maximum(steps, 1.0)
        push = np.clip(needed * self._habits.haste[count, self._row], LEAST_PUSH * 1.06, FULL_PUSH)
        push = np.where(push > 0.92 * FULL_PUSH, FULL_PUSH, push)
        harder = holding & ~there & (needed > 1.35 * np.abs(self._side))
        change = begin | harder
        self._side[change] = (np.sign(way) * push)[change]
        self._side[self._time < self._habits.side_pause] = 0.0

    def _avoid(self, seen: np.ndarray, decision: np.ndarray, cruise: np.ndarray) -> np.ndarray:
        """Removes the part of a decision that would hit a cylinder within the next steps."""
        margin = self._habits.margin + self._habits.caution * np.abs(decision[:, 0]) / FULL_PUSH
        self._blocked[:] = False
        ahead = np.arange(1, 5)[None, :, None] * decision[:, None] + seen[:, None]  # [n, 4, 2]
        decision = decision.copy()
        for _, x, y, radius, _ in OBSTACLES:
            near = np.linalg.norm(ahead - (x, y), axis=-1).min(1) < radius + ROD_RADIUS + margin
            towards = decision[:, 0] * (x - seen[:, 0]) > 0
            in_front = seen[:, 1] < y - 0.6 * radius
            beside = near & ~in_front & towards
            decision[beside, 0] = 0.0
            decision[beside, 1] = cruise[beside]
            decision[near & in_front, 1] = 0.0
            self._blocked |= near & in_front
            cramped = near & in_front & (self._side == 0)  # aims too near to the cylinder: more room on the next try
            rows = self._row[cramped]
            self._habits.gap_x[cramped, rows] += 0.0015 * np.sign(self._habits.gap_x[cramped, rows] - x)
        return decision


def _draw(mode: int, generator: np.random.Generator) -> dict[str, Any]:
    """Draws the habits and errors of one episode, all that is random about it (m and control steps).

    ``gap_x`` is the goal in each row (entry 3: after the last one), to be reached ``gate`` before the row; the next gap
    becomes the goal ``release`` after the row. ``tolerance``, ``haste``, ``patience``, ``creep`` and ``ease`` shape the
    pushes; ``margin`` (``+ caution`` at full sideways push) is the distance kept from cylinders; ``attention`` is the
    weight of the observed against the commanded position; series over time are drifting noise.
    """
    uniform, normal = generator.uniform, generator.normal
    gaps = [GAPS[row][gap] for row, gap in enumerate(mode_gaps(mode))]
    gap_x = [uniform(low, high) for low, high in gaps]
    long_pause = generator.random() < 0.13
    row1, row2, _ = mode_gaps(mode)
    pause = generator.integers(7, 19) if long_pause else generator.integers(-3, 4)
    brisk = generator.random() < 0.6
    start = uniform(0.88, 1.02) if brisk else uniform(0.66, 0.88)
    warm_up = np.clip(np.arange(_HORIZON) / uniform(10, 45), 0, 1)
    cruise = (start + (uniform(0.98, 1.06) - start) * warm_up) + ar1_noise(generator, 15, 0.05, _HORIZON)
    lets_go = generator.random() < 0.35
    turns = generator.random() < 0.5
    return {
        "gap_x": np.array([*gap_x, gap_x[-1] + normal(0, 0.012)]),
        "gate": np.append(uniform(-0.005, 0.040, 3), 0.0),
        "release": np.append(uniform(0.010, 0.042, 3), 0.0),
        "tolerance": np.append(uniform(0.008, 0.014, 3), 0.02),
        "haste": np.append(uniform(0.9, 1.15, 3), 1.0),
        "attention": uniform(0.1, 0.4),
        "caution": uniform(0.005, 0.011),
        "ease": uniform(0.3, 0.8),
        "patience": uniform(1.0, 5.0),
        "creep": uniform(0.6, 1.1),
        "margin": uniform(0.010, 0.014),
        "open": np.array([2 * row1 - 1, row2 - 1, 0, 0]),  # sign of the side without further cylinders
        "pause": max(pause, 0),
        "head_start": max(-pause, 0),
        "side_pause": max(pause, 0) + (generator.integers(2, 8) if generator.random() < 0.5 else 0),
        "linger": 4 + generator.geometric(0.3),
        "last_side": uniform(-0.008, 0.008) if turns else 0.0,
        "last_forward": uniform(-0.1, 0.2) if lets_go else 1.0,
        "cruise": np.clip(cruise, 0.4, uniform(1.0, 1.05)) * FULL_PUSH,
        "grip": 1 + ar1_noise(generator, 8, 0.06, _HORIZON),
        "misjudgement": np.stack([ar1_noise(generator, 12, 0.003, _HORIZON) for _ in range(2)], axis=1),
        "tremor": np.stack([ar1_noise(generator, 2, 0.0002, _HORIZON) for _ in range(2)], axis=1),
    }
