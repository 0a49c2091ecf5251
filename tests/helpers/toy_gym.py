# This source code is licensed under the MIT license found in the LICENSE file.
"""A robot of two joints in Gymnasium, that reports success in different ways, and demonstrations of it."""

from __future__ import annotations

import gymnasium
import numpy as np

NAMES = ("q1", "q2", "goal_1", "goal_2")


class Reach(gymnasium.Env):
    """Joints follow delta commands with a lag; an episode begins anywhere, and lasts ``length`` steps.

    With ``count`` the task counts as done in step ``count`` of every episode, whatever the robot does.
    """

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, key=None, count=3, length=6, terminates=False):
        self.key, self.count, self.length, self.terminates = key, count, length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.joints, self.goal = self.np_random.uniform(-1, 1, (2, 2))
        self.speed, self.time = np.zeros(2), 0
        return self._observe(), {}

    def step(self, action):
        self.speed = 0.6 * self.speed + 0.4 * np.asarray(action, dtype=np.float64)
        self.joints = self.joints + self.speed
        self.time += 1
        now = self.time == self.count
        info = {} if self.key is None else {self.key: now}
        terminated = self.terminates and self.time >= self.count
        reward = 1.0 if now and self.terminates == "won" else 0.0
        return self._observe(), reward, bool(terminated), self.time >= self.length, info

    def _observe(self):
        return np.concatenate([self.joints, self.goal])


def demonstrations(number=5, steps=30, seed=0):
    """States and actions of a robot that goes to its goal."""
    env, states, actions = Reach(length=steps), [], []
    for index in range(number):
        rows, taken = [env.reset(seed=seed + index)[0]], []
        for _ in range(steps):
            taken.append(0.15 * (rows[-1][2:] - rows[-1][:2]) + env.np_random.normal(0, 0.002, 2))
            rows.append(env.step(taken[-1])[0])
        states.append(np.array(rows))
        actions.append(np.array(taken))
    return states, actions


for _id, _options in {
    "ToyReach-v0": {"key": "is_success"},
    "ToyReachOwnKey-v0": {"key": "arrived"},
    "ToyReachWon-v0": {"terminates": "won"},
    "ToyReachLost-v0": {"terminates": "lost"},
}.items():
    gymnasium.register(_id, entry_point=Reach, kwargs=_options)
