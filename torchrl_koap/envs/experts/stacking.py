# This source code is licensed under the MIT license found in the LICENSE file.
"""Scripted expert of Stacking: a simulated operator of the gripper who stacks the three boxes in a given order.

Its actions follow from the present observation, so similar situations give similar motions. For every box::

    reach     fingers open, over the box at a safe height, at the yaw of the box, down once above it
    grasp     fingers close until they stop
    carry     up, over to the stack, turned back, down once above it
    release   fingers open; then up and on to the next box

A box that slipped or fell is fetched again. The expert decides poses of the tool centre point (TCP); the controller's
inverse kinematics give the joint commands.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import numpy as np

from torchrl_koap.envs.experts.recording import Expert, ar1_noise
from torchrl_koap.envs.mujoco.kinematics import follow_pose, tcp_pose
from torchrl_koap.tasks.action_rules import OPEN
from torchrl_koap.tasks.stacking import BOXES, ORDERS, TARGET

GRIPPER_CLOSED = 0.06  # gripper command: resulting distance of the fingers (m)
HALF_SIZES = np.array([size[:2] for _, size in BOXES])
BOX_HEIGHT = 0.06
ON_TABLE = 0.011  # height of the centre of a box that lies on the table (m)

_SPEED, _PUSH = 0.0125, 0.0012  # sideways: m per control step, and its change per control step
_SINK, _RISE, _LIFT = 0.0075, 0.01, 0.001  # down, up: m per control step, and their change
_TURN, _TURN_PUSH = 0.028, 0.004  # rad per control step, and its change
_EAGERNESS = np.array([0.15, 0.15, 0.12])  # share of the remaining way per control step
_HOLD = 0.004  # height of the TCP above the centre of a grasped box (m)
_FINGER_AT, _FINGER_HALF = 0.051, (0.015, 0.011)  # an open finger: distance from the TCP, half sizes (m)
_CLEAR = 0.003  # room that a finger needs beside it (m)
_PUSHED = 0.012  # m; a command this far from the expert's was moved by others: larger than errors of inverse kinematics
_HORIZON = 1500  # control steps for which hand noise is drawn


class StackingExpert(Expert):
    """Scripted expert of Stacking; modes are orders of the boxes, ``ORDERS``.

    It has finished when it has released the third box and moved away.
    """

    TASK, most_rows = "stacking", 999

    def __init__(self, modes: Sequence[int], contexts: np.ndarray, seeds: Sequence):
        super().__init__(modes, contexts, seeds)
        self._people = [
            _Person(ORDERS[mode], np.random.default_rng(seed)) for mode, seed in zip(modes, seeds, strict=True)
        ]

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns changes of the commanded joints (rad) and gripper commands (m) [n, 8] for observations [n, 31]."""
        seen = {name: observation[:, columns] for name, columns in self.task.observation.items()}
        commanded = seen["desired_joints_and_gripper"][:, :7]
        _, turned = tcp_pose(seen["measured_joints"])
        start, _ = tcp_pose(commanded)
        boxes = np.stack(
            [np.c_[seen[f"{name}_position"], np.arctan(seen[f"{name}_tan_yaw"])] for name, _ in BOXES], axis=1
        )
        poses, gripper = np.empty((len(self._people), 7)), np.empty((len(self._people), 1))
        for i, person in enumerate(self._people):
            yaw = 2 * math.atan2(turned[i, 2], turned[i, 1])
            tcp, width = seen["tcp_position"][i], seen["gripper_width"][i, 0]
            if person.position is None:
                person.position, person.yaw = start[i].copy(), yaw
            elif np.linalg.norm(start[i] - person.position) > _PUSHED:  # a disturbance moved the command: go on there
                person.position, person.yaw = start[i].copy(), math.remainder(yaw, 2 * math.pi)
            gripper[i] = person.decide(tcp, math.remainder(yaw, 2 * math.pi), width, boxes[i])
            half = person.yaw / 2
            poses[i] = (*person.position, 0.0, math.cos(half), math.sin(half), 0.0)
        self.finished[:] = [person.finished for person in self._people]
        return np.concatenate([follow_pose(commanded, poses) - commanded, gripper], axis=1)


class _Person:
    """One episode: commanded TCP position (m) and yaw (rad), stage, and habits drawn from the generator."""

    def __init__(self, order: tuple[int, ...], generator: np.random.Generator):
        self.order, self.yaw = order, 0.0
        self.position: np.ndarray | None = None
        self._grasp: tuple[float, float] | None = None
        self.finished = False
        self._pace = generator.uniform(0.85, 1.05)
        self._centre = np.array(TARGET) + generator.uniform(-0.004, 0.004, 2)
        self._wobble = np.stack([ar1_noise(generator, 12, 0.0012, _HORIZON) for _ in range(3)], axis=1)
        self._hesitation = generator.integers(0, 4, 16)
        self._velocity, self._spin = np.zeros(3), 0.0
        self._time, self._placed, self._grip_width = 0, 0, 0.0
        self._speed, self._seen = 0.0, np.zeros(3)
        self._enter(self._reach)

    def decide(self, tcp: np.ndarray, yaw: float, width: float, boxes: np.ndarray) -> float:
        """Moves the command by one control step, given an observation; returns the gripper command."""
        self._time += 1
        self._since += 1
        self._speed, self._seen = np.linalg.norm(tcp - self._seen), tcp.copy()
        return self._stage(tcp, yaw, width, boxes)

    def _enter(self, stage: Callable[..., float]) -> None:
        self._stage, self._since, self._down = stage, 0, False

    def _reach(self, tcp, yaw, width, boxes) -> float:
        self._recount(tcp, boxes)
        box = boxes[self.order[self._placed]]
        far = np.linalg.norm(box[:2] - tcp[:2])
        if self._grasp is None or far > 0.06:
            self._grasp = _choose_grasp(self.order[self._placed], boxes)
        turn, shift = self._grasp
        goal = box[:2] + shift * np.array([math.cos(turn), math.sin(turn)])
        error, tilt = np.linalg.norm(goal - tcp[:2]), abs(turn - yaw)
        low, off = box[2] + _HOLD, error + 0.08 * max(tilt - 0.03, 0.0)
        if off < 0.008:
            self._down = True
        elif off > 0.012 and tcp[2] > box[2] + 0.025:  # the fingers would hit the box
            self._down = False
        height = low if self._down else box[2] + 0.05 + _funnel(off, 0.0, 0.02, 0.009, 0.03)
        self._move(goal, max(height, self._above_stack(tcp)), turn, tcp)
        there = error < 0.007 and tilt < 0.05 and abs(tcp[2] - low) < 0.008
        if (there and width > 0.07 and self._since > 8) or (tcp[2] - low < 0.03 and self._since > 250):
            self._enter(self._close)
        return OPEN

    def _close(self, tcp, yaw, width, boxes) -> float:
        self._velocity[:], self._spin = 0.5 * self._velocity, 0.5 * self._spin
        wait = 5 + self._hesitation[self._time % 16]
        if self._since > wait and (abs(width - self._grip_width) < 0.0005 or self._since > 25):
            if width < 0.05:
                self._grasp = None
                self._enter(self._reach)
            else:
                self._enter(self._carry)
        self._grip_width = width
        return GRIPPER_CLOSED

    def _carry(self, tcp, yaw, width, boxes) -> float:
        index = self.order[self._placed]
        box = boxes[index]
        offset = tcp - box[:3]
        if np.linalg.norm(offset) > 0.05 or width < 0.05:  # the box is lost
            self._grasp = None
            self._enter(self._reach)
            return OPEN
        goal, height = self._place(boxes)
        error, tilt = np.linalg.norm(goal - box[:2]), abs(yaw)
        low = height + offset[2]
        near = _funnel(error + 0.08 * max(tilt - 0.03, 0.0), low, low + 0.045, 0.008, 0.035)
        far = min(max(near, _funnel(0.25 - error, 0.105, low + 0.045, 0.0, 0.12)), max(low + 0.045, 0.105))
        self._move(goal + offset[:2], near if error < 0.06 else far, 0.0, tcp)
        down = box[2] < height + 0.003 and abs(self.position[2] - low) < 0.004
        if down and error < 0.009 and tilt < 0.06 and self._speed < 0.001:
            self._enter(self._open)
        return GRIPPER_CLOSED

    def _open(self, tcp, yaw, width, boxes) -> float:
        self._velocity[:], self._spin = 0.5 * self._velocity, 0.5 * self._spin
        wait = 4 + self._hesitation[self._time % 16]
        if self._since > wait and width > 0.077:
            self._placed += 1
            self._grasp = None
            self._enter(self._retreat if self._placed == 3 else self._reach)
        return OPEN

    def _retreat(self, tcp, yaw, width, boxes) -> float:
        self._move(tcp[:2], ON_TABLE + 3 * BOX_HEIGHT, 0.0, tcp)
        self.finished |= self._since > 12
        return OPEN

    def _place(self, boxes: np.ndarray) -> tuple[np.ndarray, float]:
        """Returns the goal of the centre of the held box: xy and height."""
        if not self._placed:
            return self._centre, ON_TABLE
        below = boxes[self.order[self._placed - 1]]
        return below[:2], below[2] + BOX_HEIGHT

    def _recount(self, tcp: np.ndarray, boxes: np.ndarray) -> None:
        """Counts the stack again; boxes that have moved must be fetched again."""
        if np.linalg.norm(tcp[:2] - self._centre) < 0.12:
            return
        for place in range(self._placed):
            box = boxes[self.order[place]]
            if np.linalg.norm(box[:2] - TARGET) > 0.055 or abs(box[2] - ON_TABLE - place * BOX_HEIGHT) > 0.02:
                self._placed, self._grasp = place, None
                return

    def _above_stack(self, tcp: np.ndarray) -> float:
        """Returns the height that open fingers need at their place to pass the stack."""
        if not self._placed:
            return 0.0
        top = ON_TABLE + (self._placed - 0.5) * BOX_HEIGHT
        return _funnel(0.17 - np.linalg.norm(tcp[:2] - self._centre), 0.0, top + 0.035, 0.0, 0.08)

    def _move(self, goal: np.ndarray, height: float, turn: float, tcp: np.ndarray) -> None:
        """Accelerates, brakes and steers towards a goal; moves sideways only near or above the height of the goal."""
        freedom = np.clip((0.02 - (height - tcp[2])) / 0.015, 0.0, 1.0)
        wobble = self._wobble[self._time % _HORIZON]
        far = np.linalg.norm(goal - tcp[:2]) > 0.03
        way = np.append(goal, height) + (wobble if far else 0.0) - self.position
        wanted = _EAGERNESS * way
        wanted[:2] = _limited(wanted[:2], _SPEED * self._pace * freedom)
        wanted[2] = np.clip(wanted[2], -_SINK * self._pace, _RISE * self._pace)
        change = wanted - self._velocity
        self._velocity += np.append(_limited(change[:2], _PUSH), np.clip(change[2], -_LIFT, _LIFT))
        self.position += self._velocity
        spin = np.clip(0.2 * (turn - self.yaw), -_TURN, _TURN) * self._pace
        self._spin += np.clip(spin - self._spin, -_TURN_PUSH, _TURN_PUSH)
        self.yaw += self._spin


def _choose_grasp(index: int, boxes: np.ndarray) -> tuple[float, float]:
    """Chooses a grasp of a box: yaw of the gripper and shift along its width (rad, m).

    Of equivalent yaws, takes the one nearest to the neutral seventh joint, unless another box is in the way.
    """
    box, others = boxes[index], [other for other in range(3) if other != index]
    long = HALF_SIZES[index, 1] > 0.04
    neutral = math.atan2(box[1], box[0])
    period = math.pi if long else math.pi / 2
    nearest = neutral + math.remainder(box[3] + (math.pi / 2 if long else 0.0) - neutral, period)
    turns = [nearest] if long else [nearest, nearest - math.copysign(period, nearest - neutral)]
    shifts = (0.0, 0.008, -0.008, 0.014, -0.014, 0.022, -0.022, 0.03, -0.03)[: 9 if long else 5]
    best, most = None, -math.inf
    for shift, turn in itertools.product(shifts, turns):
        room = min(_room(box[:2], turn, shift, boxes[other], HALF_SIZES[other]) for other in others)
        if room > _CLEAR:
            return turn, shift
        if room > most:
            best, most = (turn, shift), room
    return best


def _room(place: np.ndarray, turn: float, shift: float, other: np.ndarray, half: np.ndarray) -> float:
    """Returns the least distance (m; negative inside) of the open fingers from another box, along its sides."""
    across, along = np.array([math.sin(turn), -math.cos(turn)]), np.array([math.cos(turn), math.sin(turn)])
    grid = np.array(list(itertools.product((-1, 0, 1), (-1, 0, 1))))
    room = math.inf
    for side in (-1, 1):
        centre = place + shift * along + side * _FINGER_AT * across
        points = centre + grid[:, :1] * _FINGER_HALF[0] * across + grid[:, 1:] * _FINGER_HALF[1] * along
        c, s = math.cos(other[3]), math.sin(other[3])
        inside = np.abs((points - other[:2]) @ np.array([[c, -s], [s, c]])) - half
        room = min(room, inside.max(1).min())
    return room


def _funnel(error: float, low: float, high: float, tight: float, wide: float) -> float:
    """Returns ``low`` for errors below ``tight``, ``high`` above ``wide``, interpolated in between."""
    return low + (high - low) * min(max((error - tight) / (wide - tight), 0.0), 1.0)


def _limited(vector: np.ndarray, length: float) -> np.ndarray:
    """Returns the vector, shortened to ``length`` if it is longer."""
    return vector * min(1.0, length / max(np.linalg.norm(vector), 1e-12))
