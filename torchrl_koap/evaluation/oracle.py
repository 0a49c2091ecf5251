# This source code is licensed under the MIT license found in the LICENSE file.
"""Follows plans by an inverse of the simulator in place of a controller: what still fails is due to the planner.

The simulation is run ahead with the command held, and with a small change of it in each direction. An arm under its
tracking law responds nearly linearly, so least squares give the commands of the next steps (dynamic matrix control:
Cutler and Ramaker, 1980). The first of these commands is executed::

    y_k = held_k + sum_{j < k} S_{k-j} a_j         state after k steps, S the response to a step of the command
    min_a  sum_k |y_k - plan_k|^2  +  smoothness sum_j |a_j - a_{j-1}|^2
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_koap.modules import blend_plan
from torchrl_koap.modules.execution.followers import Follower, command_rest
from torchrl_koap.tasks import Task

LOOK_AHEAD = 4  # control steps over which the plan is followed; the arm needs about three to follow a command
SMOOTHNESS = 0.02  # weight of a change of the action against a distance from the plan
_REFRESH = 8  # control steps between measurements of the response, which changes with the arm's joints
_PUSH = {"m": 0.004, "rad": 0.01}  # change of a command that measures the response


class OracleFollower(Follower):
    """Executes the commands that move the simulated robot along plans.

    It reads the simulation in place of the observation, which no real robot can do. The environment of the task must be
    a :class:`~torchrl_koap.envs.ManipulationEnv`, and the task must say which state columns its actions move.
    """

    knows_command = True

    def __init__(self, task: Task, *, blend: float):
        super().__init__()
        if task.env is None:
            raise ValueError(f"task {task.name!r} has no environment: the strategy 'oracle' needs its simulation")
        self.task, self.blend = task, blend
        self._rule = task.action_rule if task.gripper is not None else None
        self._changes, self._moved = list(task.moves), list(task.moves.values())
        if not task.moves or task.targets:
            raise ValueError(f"task {task.name!r} does not say which state columns its actions move (Action.column)")
        units = task.action_units
        self._pushes = np.array([_PUSH.get(units[i], 0.01) for i in self._changes])
        self._env: EnvBase | None = None

    def attach(self, env: EnvBase) -> None:
        """Sets the environment whose episodes are about to begin; it must be able to simulate actions ahead."""
        base = env.base_env if isinstance(env, TransformedEnv) else env
        count, size = base.batch_size[0], len(self._changes)
        self._env, self._time, self._last = base, 0, np.zeros((count, size))
        self._matrix = np.zeros((count, LOOK_AHEAD * size, LOOK_AHEAD * size))

    def forward(self, observations: Tensor, states: Tensor, plan: Tensor, steps: int = 1) -> Tensor:
        """Returns the action ``[n, 1, act]`` whose effect is nearest to the plan; arguments as for the base class.

        Observations are one step late, so the first planned state is the present one.
        """
        if self._env is None:
            raise RuntimeError("the strategy 'oracle' does not know its environment: call policy.attach(env) first")
        if steps != 1:
            raise RuntimeError("the strategy 'oracle' reads the simulation at every step: it decodes one action")
        bent = blend_plan(states, plan, self.blend)
        rows = np.flatnonzero(~self._env.over)  # the policy leaves out episodes that are over
        action = command_rest(self._rule, states, plan, self.task.action_dim, 1)[:, 0].double().cpu().numpy()
        action[:, self._changes] = 0.0
        wanted = bent[:, 1 : LOOK_AHEAD + 1][..., self._moved].double().cpu().numpy()
        action[:, self._changes] = self._last[rows] = self._solve(rows, action, wanted)
        return torch.as_tensor(action, dtype=plan.dtype, device=plan.device).unsqueeze(1)

    def _solve(self, rows: np.ndarray, held: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Returns first actions ``[n, a]`` that follow ``wanted [n, k, a]``; ``held [n, act]`` keep the commands."""
        steps, size = LOOK_AHEAD, len(self._changes)
        refresh = self._time % _REFRESH == 0
        tries = np.tile(held[None, :, None], (1 + size * refresh, 1, steps, 1))
        for entry in range(size * refresh):
            tries[1 + entry, :, 0, self._changes[entry]] += self._pushes[entry]
        seen = self._env.simulate_actions(tries, rows)
        moved = self.task.state_of(torch.from_numpy(seen))[..., self._moved].numpy()  # [1 + a, n, k, a]
        if refresh:
            response = (moved[1:] - moved[0]) / self._pushes[:, None, None, None]  # to a step of one entry
            matrix = np.zeros((len(rows), steps, size, steps, size))
            for begin in range(steps):
                matrix[:, begin:, :, begin] = response[:, :, : steps - begin].transpose(1, 2, 3, 0)
            self._matrix[rows] = matrix.reshape(len(rows), steps * size, steps * size)
        self._time += 1
        matrix, rough = self._matrix[rows], np.kron(np.eye(steps) - np.eye(steps, k=-1), np.eye(size))
        normal = matrix.transpose(0, 2, 1) @ matrix + SMOOTHNESS * rough.T @ rough
        goal = (matrix.transpose(0, 2, 1) @ (wanted - moved[0]).reshape(len(rows), -1, 1))[..., 0]
        goal[:, :size] += SMOOTHNESS * self._last[rows]
        return np.linalg.solve(normal, goal[..., None])[:, :size, 0]
