# This source code is licensed under the MIT license found in the LICENSE file.
"""The plane of the puck: a robot that moves as told, and a puck that it pushes out of its way."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from puck.task import GATE_Y, GOAL, GOAL_RADIUS, POST, PUCK_RADIUS, ROBOT_RADIUS, TASK
from torchrl_koap.envs.contexts import check_contexts, draw_contexts

START = (0.5, 0.0)  # of the robot (m)


class PuckEnv(EnvBase):
    """A batch of planes.

    Args:
        num_envs (int): number of environments.
        num_threads (int): not needed.
        max_steps (int): control steps after which an episode is truncated.
        seed (int, optional): of the random contexts.
        dtype (torch.dtype): of observation, action and reward.
    """

    def __init__(self, num_envs=1, num_threads=1, max_steps=200, seed=None, dtype=torch.float32):
        super().__init__(batch_size=[num_envs])
        self.max_steps, self._dtype = max_steps, dtype
        self._robot, self._puck = np.zeros((num_envs, 2)), np.zeros((num_envs, 2))
        self._mode = np.full(num_envs, -1)
        self._success, self._steps = np.zeros(num_envs, dtype=bool), np.zeros(num_envs, dtype=int)
        shape, flag = self.batch_size, {"n": 1, "shape": (num_envs, 1), "dtype": torch.bool}
        self.observation_spec = Composite(
            observation=Unbounded((*shape, 4), dtype=dtype),
            success=Binary(**flag),
            mode=Bounded(-1, 1, (*shape, 1), dtype=torch.int64),
            context=Unbounded((*shape, 1, 3), dtype=dtype),
            shape=shape,
        )
        self.action_spec = Bounded(-0.015, 0.015, (*shape, 2), dtype=dtype)
        self.reward_spec = Bounded(0.0, 1.0, (*shape, 1), dtype=dtype)
        done = Categorical(2, (*shape, 1), dtype=torch.bool)
        self.done_spec = Composite(done=done, terminated=done.clone(), truncated=done.clone(), shape=shape)
        self._contexts = np.zeros((num_envs, 1, 3))
        self._set_seed(seed)

    def _set_seed(self, seed):
        self._generator = np.random.default_rng(seed)

    def _reset(self, tensordict=None, *, contexts=None, **kwargs):
        drawn = draw_contexts(TASK, len(self._puck), self._generator) if contexts is None else contexts
        self._contexts = check_contexts(TASK, drawn)
        self._robot[:], self._puck[:] = START, self._contexts[:, 0, :2]
        self._mode[:], self._success[:], self._steps[:] = -1, False, 0
        return self._leaves()

    def _step(self, tensordict):
        self._robot += tensordict["action"].double().numpy()
        away = self._puck - self._robot
        distance = np.linalg.norm(away, axis=1, keepdims=True)
        overlap = np.maximum(PUCK_RADIUS + ROBOT_RADIUS - distance, 0)
        self._puck += overlap * away / np.maximum(distance, 1e-9)
        passed = (self._puck[:, 1] >= GATE_Y) & (self._mode < 0)
        self._mode[passed] = (self._puck[passed, 0] >= POST[0]).astype(int)
        self._success |= np.linalg.norm(self._puck - GOAL, axis=1) < GOAL_RADIUS
        self._steps += 1
        return self._leaves().set("reward", torch.tensor(self._success[:, None], dtype=self._dtype))

    def _leaves(self):
        truncated = self._steps >= self.max_steps
        flags = {"success": self._success, "terminated": self._success, "truncated": truncated}
        flags["done"] = self._success | truncated
        leaves = {name: torch.tensor(value[:, None].copy()) for name, value in flags.items()}
        leaves["observation"] = torch.tensor(np.concatenate([self._robot, self._puck], 1), dtype=self._dtype)
        leaves["mode"] = torch.tensor(self._mode[:, None].copy())
        leaves["context"] = torch.tensor(self._contexts, dtype=self._dtype)
        return TensorDict(leaves, self.batch_size)
