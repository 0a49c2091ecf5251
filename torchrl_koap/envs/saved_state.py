# This source code is licensed under the MIT license found in the LICENSE file.
"""The state of an episode in progress, taken out of an environment and put back."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np

from torchrl_koap.envs.mujoco import controller


class SavedState(abc.ABC):
    """Base of :class:`~torchrl_koap.envs.base.ManipulationEnv`: saves, restores and sets what one environment is in.

    Reads and writes ``sims`` (:class:`~torchrl_koap.envs.mujoco.simulation.SimulationBatch`) and the arrays of the
    episodes.

    Examples:
        >>> from torchrl_koap.envs import AvoidingEnv
        >>> env = AvoidingEnv(num_envs=2)
        >>> _ = env.rollout(3)
        >>> env.set_state(1, env.get_state(0))
        >>> bool((env.commands[0] == env.commands[1]).all())
        True
    """

    sims: Any
    # everything about the episodes in progress, a row per environment
    _EPISODE = tuple("_observation _commands _mode _success _collision _seen _steps _ready _contexts".split())

    @abc.abstractmethod
    def _begin_episode(self, rows: np.ndarray) -> None: ...

    def get_state(self, index: int) -> dict:
        """Full state of one environment: simulation, controller, command, mode, outcome and step count.

        Args:
            index (int): which environment.

        Returns:
            dict: arrays for :meth:`set_state`; also valid in another environment of the same task.
        """
        rows = {name: np.copy(getattr(self, name)[index]) for name in self._EPISODE}
        return {"simulation": self.sims.get_state(index)} | rows

    def set_state(self, index: int, state: dict) -> None:
        """Restores what :meth:`get_state` returned; the episode then continues bit for bit.

        Args:
            index (int): which environment.
            state (dict): from :meth:`get_state`, of any environment of the same task.
        """
        self.sims.set_state(index, state["simulation"])
        for name, value in state.items():
            if name != "simulation":
                getattr(self, name)[index] = value

    def set_physics(self, index: int, qpos, qvel=None, *, qacc_warmstart=None, ctrl=None, time: float = 0.001) -> None:
        """Starts a fresh episode of one environment from a given physics state.

        Args:
            index (int): which environment; its context stays.
            qpos (array): positions [nq] (m, rad).
            qvel (array, optional): velocities [nv]; zero if not given.
            qacc_warmstart (array, optional): warm start of the solver [nv].
            ctrl (array, optional): motor commands of the substep before [nu].
            time (float): clock (s).

        Raises:
            ValueError: if a size is wrong.
        """
        self.sims.set_physics(index, qpos, qvel, qacc_warmstart=qacc_warmstart, ctrl=ctrl, time=time)
        self.sims.widths[index] = controller.FINGER_OPEN
        self._begin_episode(np.array([index]))
