# This source code is licensed under the MIT license found in the LICENSE file.
"""A scripted player that pushes the puck past the post on the side asked for, and into the goal."""

from __future__ import annotations

import numpy as np

from puck.task import GATE_Y, GOAL, GOAL_RADIUS, POST, PUCK_RADIUS, ROBOT_RADIUS
from torchrl_koap.envs.experts.recording import Expert

SPEED = 0.008  # m per control step
REACH = PUCK_RADIUS + ROBOT_RADIUS


class PuckExpert(Expert):
    """Players of a batch of episodes.

    Args:
        modes (sequence of int): side of each episode, 0 left, 1 right.
        contexts (array): not looked at, the puck is seen.
        seeds (sequence): seed of each episode, of the place where it passes the post.
    """

    def __init__(self, modes, contexts, seeds):
        sides = [2 * mode - 1 for mode in modes]
        wide = [np.random.default_rng(seed).uniform(0.05, 0.09) for seed in seeds]
        self._gates = np.array([(POST[0] + side * w, GATE_Y + 0.02) for side, w in zip(sides, wide, strict=True)])
        self._passed = np.zeros(len(self._gates), dtype=bool)
        self.finished = np.zeros(len(self._gates), dtype=bool)

    def act(self, observation):
        """Changes of the robot's place [n, 2] from observations [n, 4] (m)."""
        return np.stack([self._move(row, seen[:2], seen[2:]) for row, seen in enumerate(observation)])

    def _move(self, row, robot, puck):
        self._passed[row] |= puck[1] > GATE_Y
        target = np.array(GOAL) if self._passed[row] else self._gates[row]
        self.finished[row] |= np.linalg.norm(puck - GOAL) < 0.6 * GOAL_RADIUS
        if self.finished[row]:
            return np.zeros(2)
        ahead = (target - puck) / max(np.linalg.norm(target - puck), 1e-9)
        across = np.array([-ahead[1], ahead[0]])
        off = robot - puck
        along, aside = off @ ahead, off @ across
        if along < -0.75 * REACH and abs(aside) < 0.5 * REACH:  # behind the puck: push, and come back to the line
            wanted = ahead - np.clip(80 * aside, -3, 3) * across
        elif along < -0.75 * REACH:  # to a place behind it
            wanted = -1.5 * REACH * ahead - off
        elif abs(aside) < 1.5 * REACH:  # make room beside it first
            wanted = np.copysign(1.0, aside) * across - 0.2 * ahead
        else:
            wanted = -ahead
        return SPEED * wanted / np.linalg.norm(wanted)
