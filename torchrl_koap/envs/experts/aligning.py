# This source code is licensed under the MIT license found in the LICENSE file.
"""Scripted expert of Aligning: a joystick player that pushes the tray into the target pose, from inside or outside.

The player picks the contact (a corner inside the tray, or a point on one of its walls) from which one smooth push leads
to the target, and then

    1. travels     with the rod above the tray to the place where it is lowered
    2. lowers      the rod, inside the tray (mode 0) or beside a wall (mode 1)
    3. pushes      and at every control step corrects the rest of the plan
                   (:mod:`torchrl_koap.envs.experts.push_planning`) by the observed motion of the tray
    4. lets go     when this contact brings no more progress, and picks another one: through the middle of the
                   tray (mode 0), or over its walls (mode 1)

From inside, a corner holds the rod best and is used for most of the way; the last centimetres are pushed at a wall.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from torchrl_koap.envs.aligning import aligned
from torchrl_koap.envs.experts.push_planning import LENGTH, PLAN_SIZE, arrive, improve, motion, search, two_pushes
from torchrl_koap.envs.experts.recording import Expert, ar1_noise

SAFE_HEIGHT = 0.25  # TCP height (m) at which the rod passes over the walls
PUSH_HEIGHT = (0.150, 0.130)  # inside, outside; the rod's tip is 0.12 m lower
FULL_PUSH = 0.0095  # m per control step and axis
SURGE = 0.0025  # m per control step; largest change of the push between steps
_INSIDE, _OUTSIDE = 0, 1
_WALL_CONE, _CORNER_CONE = math.radians(26), math.radians(68)
_CORNERS = 20  # contacts from this one on are corners
_REACH = (0.30, 0.75, -0.42, 0.60)  # where the rod may be lowered: x, x, y, y (m)
_BETWEEN = np.array([0.36, 0.66, -0.28, 0.40])  # where the tray may be on the way: x, x, y, y (m)
_LEAST, _MOST = ((*_REACH[i::2], *_BETWEEN[i::2]) for i in (0, 1))
_SWITCH_COST = 5.0
_ROUND = 0.115  # distance of the rod from the centre on its way around the tray (m)
_HORIZON = 500  # control steps for which hand noise is drawn


def _contacts() -> tuple[np.ndarray, np.ndarray]:
    """Returns contacts inside (five per wall, four corners) and outside (five per wall), rows of eight numbers."""
    inside, outside = [], []
    for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        for offset in (-0.024, -0.012, 0.0, 0.012, 0.024):
            touched, rod = ((d * c - offset * s, d * s + offset * c) for d in (0.045, 0.035))
            inside.append((*touched, math.atan2(s, c), _WALL_CONE, *rod, 0.05, 0.03))
        for offset in (-0.032, -0.016, 0.0, 0.016, 0.032):
            touched, rod = ((d * c - offset * s, d * s + offset * c) for d in (0.055, 0.065))
            outside.append((*touched, math.atan2(-s, -c), _WALL_CONE, *rod, 0.07, 0.01))
    for x, y in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        rod = (0.035 * x, 0.035 * y)
        inside.append((*rod, math.atan2(y, x), _CORNER_CONE, *rod, 0.05, 0.03))
    return np.array(inside), np.array(outside)


CONTACTS = _contacts()


class AligningExpert(Expert):
    """Scripted expert of Aligning: pushes trays into their target poses from inside (mode 0) or outside (1).

    It has finished when it has seen the tray in the target pose and released it.
    """

    TASK, most_rows = "aligning", 399

    def __init__(self, modes: Sequence[int], contexts: np.ndarray, seeds: Sequence):
        super().__init__(modes, contexts, seeds)
        self._players = [
            _Player(int(mode), context, np.random.default_rng(seed))
            for mode, context, seed in zip(modes, contexts, seeds, strict=True)
        ]

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns changes of the commanded TCP position [n, 3] (m) for observations [n, 20]."""
        actions = np.stack([player.act(row) for player, row in zip(self._players, observation, strict=True)])
        self.finished[:] = [player.since_success > player.linger for player in self._players]
        return actions


def _yaw(quaternion: np.ndarray) -> float:
    return 2 * math.atan2(quaternion[3], quaternion[0])


def _turned(vector, yaw: float) -> np.ndarray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    return math.hypot(a[0] - b[0], a[1] - b[1])


class _Player:
    """One episode: the present stage, contact and plan, and the habits drawn from the seed."""

    def __init__(self, mode: int, context: np.ndarray, generator: np.random.Generator):
        self.mode = mode
        self.time = self.since_success = self.waited = 0
        self.contact: np.ndarray | None = None
        self.plan = np.empty(PLAN_SIZE)
        self.action, self.last_tcp, self.last_pose = np.zeros(3), np.zeros(3), np.zeros(3)
        self._begin_push()
        self.doing = self._travel
        self.pace = generator.uniform(0.88, 1.03)
        self.pause = generator.integers(0, 6)
        self.settle = generator.integers(2, 6)
        self.linger = generator.integers(3, 7)
        self.height = PUSH_HEIGHT[mode] + generator.uniform(-0.004, 0.004)
        self.slip = generator.normal(0.0, 0.002, 2)  # error of the place where the rod is lowered (m)
        self.wobble = ar1_noise(generator, 6, 0.00025, (_HORIZON, 2))
        self._choose(context[0], context[1], None)

    def act(self, observation: np.ndarray) -> np.ndarray:
        self.command, self.tcp = observation[:3], observation[3:6]
        self.pose = np.array([observation[6], observation[7], _yaw(observation[9:13])])
        self.target = np.array([observation[13], observation[14], _yaw(observation[16:])])
        self.since_success += bool(self.since_success or aligned(observation[6:13], observation[13:]))
        goal, speed = (self.command, 0.0) if self.since_success or self.time < self.pause else self.doing()
        way = goal - self.command
        way *= min(1.0, self.pace * speed / max(np.abs(way).max(), 1e-12))
        change = way - self.action
        self.action = self.action + change * min(1.0, SURGE / max(np.abs(change).max(), 1e-12))
        self.last_tcp = self.tcp
        shake = self.wobble[self.time % _HORIZON] * (np.abs(self.action).max() > 0.002)
        self.time += 1
        return self.action + np.append(shake, 0.0)

    def _choose(self, pose: np.ndarray, target: np.ndarray, rod: np.ndarray | None) -> None:
        """Picks the contact with the best plan; a rod [2] at the tray (in its frame) favours near contacts."""
        turn = (pose[2] - target[2] + math.pi) % (2 * math.pi) - math.pi
        far = _apart(pose, target) > 0.06 or abs(turn) > 0.6
        contacts, least = CONTACTS[self.mode], math.inf
        if self.mode == _INSIDE:
            contacts = contacts[_CORNERS:] if far else contacts[:_CORNERS]
        for contact in contacts:
            plan = np.empty(PLAN_SIZE)
            cost = search(pose, target, contact, plan)
            if rod is not None:
                cost += 10 * _apart(contact[4:6], rod)
            place = pose[:2] + _turned(1.3 * contact[4:6], pose[2])
            for share in (0.25, 0.5):  # of the way
                bend = share * (plan[1] - plan[0])
                part = np.array([plan[0], plan[0] + bend, plan[0] + 2 * bend, plan[LENGTH] + math.log(share)])
                x, y, _ = arrive(pose, contact, part)
                for value, low, high in zip((*place, x, y), _LEAST, _MOST, strict=True):
                    cost += 1000 * max(low - value, value - high, 0.0)
            if cost < least:
                self.contact, self.plan, self.aim, least = contact, plan, target, cost
        if self.mode == _OUTSIDE:
            between = np.empty(3)
            cost, first = two_pushes(pose, target, contacts, _BETWEEN, between)
            if cost + _SWITCH_COST < least:
                self.contact, self.aim = contacts[first], between
                search(pose, between, self.contact, self.plan)

    def _in_world(self, point: np.ndarray) -> np.ndarray:
        return self.pose[:2] + _turned(point, self.pose[2])

    def _entry(self) -> np.ndarray:
        """Returns where the rod is lowered: inside, at 35 % of the way to the contact; outside, 22 mm off the wall."""
        rod = self.contact[4:6]
        if self.mode == _INSIDE:
            return self._in_world(0.35 * rod + self.slip)
        off = 0.022 * np.array([math.cos(self.contact[2]), math.sin(self.contact[2])])
        return self._in_world(rod - off + self.slip)

    def _travel(self) -> tuple[np.ndarray, float]:
        entry = self._entry()
        goal = np.append(entry, SAFE_HEIGHT)
        still = _apart(self.tcp, self.last_tcp) < 0.003
        if _apart(entry, self.tcp) < 0.010 and _apart(entry, self.command) < 0.006 and still:
            self.doing, self.waited = self._lower, 0
        return goal, min(FULL_PUSH, 0.001 + 0.13 * np.abs(goal - self.command).max())

    def _lower(self) -> tuple[np.ndarray, float]:
        goal = np.append(self._entry(), self.height)
        if _apart(goal, self.tcp) > 0.016 and self.tcp[2] > 0.2:
            return goal, 0.0
        self.waited += abs(self.command[2] - self.height) < 0.002 and abs(self.tcp[2] - self.height) < 0.012
        if self.waited > self.settle:
            self._begin_push()
        return goal, 0.009 if self.command[2] > self.height + 0.03 else 0.005

    def _begin_push(self) -> None:
        self.doing = self._push
        self.stuck, self.progress, self.shortest, self.started = 0, 0.01, 2.0, False

    def _push(self) -> tuple[np.ndarray, float]:
        rod = _turned(self.tcp[:2] - self.pose[:2], -self.pose[2])
        contact, anchor = self._felt_contact(rod)
        soon = self.pose + 1.5 * (self.pose - self.last_pose) if self.started else self.pose
        improve(soon, self.aim, contact, self.plan, 4)
        share, length = math.tanh(self.plan[0]), math.exp(self.plan[LENGTH])
        ahead = _turned(motion(contact, share)[3:], self.pose[2])
        angle = contact[2] + contact[3] * share + self.pose[2]
        speed = min(0.008, 0.002 + 0.1 * length) * self.pace
        # the arm lags by 1.6 control steps, and yields by 8 mm to the force that moves the tray
        hold = self._in_world(anchor) + 1.6 * speed * ahead - self.command[:2]
        hold += 0.008 * np.array([math.cos(angle), math.sin(angle)])
        along = float(hold[0] * ahead[0] + hold[1] * ahead[1])
        step = min(speed, along + 0.02) * ahead + 0.35 * (hold - along * ahead)
        self._assess(rod, length)
        return np.append(self.command[:2] + step, self.height), 0.010

    def _felt_contact(self, rod: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Returns the contact at the rod's real place along the wall, and the anchor that the hand steers to."""
        contact, anchor = self.contact.copy(), self.contact[4:6].copy()
        normal = np.array([math.cos(contact[2]), math.sin(contact[2])])
        along = np.array([-normal[1], normal[0]])
        off = rod - anchor
        if contact[3] == _WALL_CONE and abs(off[0] * normal[0] + off[1] * normal[1]) < 0.006:
            place = rod[0] * along[0] + rod[1] * along[1]
            wanted = contact[0] * along[0] + contact[1] * along[1]
            slip = (min(max(place, -0.035), 0.035) - wanted) * along
            contact[:2] += slip
            anchor += 0.5 * slip
        return contact, anchor

    def _assess(self, rod: np.ndarray, length: float) -> None:
        """Ends a push that makes no more progress: its way is over, the tray rests, or the way grows again."""
        self.progress = 0.9 * self.progress + 0.1 * float(np.abs(self.pose - self.last_pose).sum())
        self.last_pose, self.shortest, self.started = self.pose, min(self.shortest, length), True
        self.stuck += 3 * (length < 0.006) + (self.progress < 2e-4)
        if self.mode == _INSIDE and self.contact[3] == _CORNER_CONE and length < 0.03:
            self.stuck += 3
        if (np.abs(rod).max() > 0.06) == (self.mode == _INSIDE):  # on the wrong side of the walls
            self.doing = self._lift
        elif self.mode == _OUTSIDE and self._behind(rod) < 0.05:  # slipped around the corner
            self.doing = self._let_go
        elif self.stuck > 6 or length > self.shortest + 0.06:
            self._choose(self.pose, self.target, rod)
            self.doing = self._let_go

    def _behind(self, rod: np.ndarray) -> float:
        """Returns how far the rod is behind the tray's centre, along the push (m)."""
        return -(rod[0] * math.cos(self.contact[2]) + rod[1] * math.sin(self.contact[2]))

    def _let_go(self) -> tuple[np.ndarray, float]:
        away = self.tcp[:2] - self.pose[:2]
        distance = max(math.hypot(*away), 1e-9)
        if self.mode == _INSIDE:
            if distance < 0.015:
                self._begin_push()
            return np.append(self.pose[:2], self.height), 0.006
        if distance > 0.09:
            self.doing = self._around
        return np.append(self.pose[:2] + 0.12 / distance * away, self.height), 0.007

    def _around(self) -> tuple[np.ndarray, float]:
        """Takes the lowered rod around the tray to the next contact."""
        entry = self._entry()
        from_centre, to_centre = self.command[:2] - self.pose[:2], entry - self.pose[:2]
        angle = math.atan2(from_centre[1], from_centre[0])
        rest = (math.atan2(to_centre[1], to_centre[0]) - angle + math.pi) % (2 * math.pi) - math.pi
        if abs(rest) > 0.35:
            angle += math.copysign(min(abs(rest), 0.4), rest)
            goal = self.pose[:2] + _ROUND * np.array([math.cos(angle), math.sin(angle)])
            return np.append(goal, self.height), 0.008
        still = _apart(self.tcp, self.last_tcp) < 0.004
        if _apart(entry, self.tcp) < 0.012 and _apart(entry, self.command) < 0.010 and still:
            self._begin_push()
        return np.append(entry, self.height), min(0.008, 0.002 + 0.2 * _apart(entry, self.command))

    def _lift(self) -> tuple[np.ndarray, float]:
        if self.tcp[2] > SAFE_HEIGHT - 0.03:
            self.doing = self._travel
        return np.append(self.command[:2], SAFE_HEIGHT), FULL_PUSH
