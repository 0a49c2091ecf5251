# This source code is licensed under the MIT license found in the LICENSE file.
"""The state of an episode in progress: saved, and restored."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np
import torch

from torchrl_koap.envs.mujoco import controller
from torchrl_koap.tasks import Task


class EpisodeState(abc.ABC):
    """Saves and restores episodes; base of :class:`~torchrl_koap.envs.base.ManipulationEnv`."""

    sims: Any
    task: Task
    batch_size: torch.Size
    _episode: dict[str, np.ndarray]  # everything about the episodes in progress, a row per environment

    @abc.abstractmethod
    def _begin_episode(self, rows: np.ndarray) -> None: ...

    @abc.abstractmethod
    def _command(self, rows: np.ndarray, action: np.ndarray) -> None:
        """Turns actions [len(rows), act] into new commands ``self._commands[rows]``; by default they are changes."""

    @abc.abstractmethod
    def _advance(self, rows: np.ndarray) -> None: ...

    @abc.abstractmethod
    def _observe(self, rows: np.ndarray) -> np.ndarray:
        """Observation [len(rows), obs] of the present state and command."""

    def get_state(self, index: int) -> dict:
        """Returns the full state of one environment, for :meth:`set_state` of any environment of the same task."""
        rows = {name: array[index].copy() for name, array in self._episode.items()}
        return {"simulation": self.sims.get_state(index)} | rows

    def set_state(self, index: int, state: dict) -> None:
        """Restores what :meth:`get_state` returned; the episode then continues bit for bit."""
        self.sims.set_state(index, state["simulation"])
        for name, array in self._episode.items():
            array[index] = state[name]

    def set_physics(self, index: int, qpos, qvel=None, *, qacc_warmstart=None, ctrl=None, time: float = 0.001) -> None:
        """Starts a fresh episode of one environment from a given physics state; its context stays.

        Positions [nq] (m, rad), velocities [nv] (default: zero), the solver's warm start [nv], motor commands of the
        substep before [nu], and the clock (s).

        Raises:
            ValueError: if a size is wrong.
        """
        self.sims.set_physics(index, qpos, qvel, qacc_warmstart=qacc_warmstart, ctrl=ctrl, time=time)
        self.sims.widths[index] = controller.FINGER_OPEN
        self._begin_episode(np.array([index]))
