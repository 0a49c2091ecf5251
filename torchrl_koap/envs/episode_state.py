# This source code is licensed under the MIT license found in the LICENSE file.
"""The state of an episode in progress: saved, restored, and advanced by trial actions."""

from __future__ import annotations

import abc
from typing import Any

import numpy as np
import torch

from torchrl_koap.tasks import Task


class EpisodeState(abc.ABC):
    """Saves, restores and tries out episodes; base of :class:`~torchrl_koap.envs.base.ManipulationEnv`."""

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
        self._begin_episode(np.array([index]))

    def simulate_actions(self, actions: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """Simulates action sequences from the present state and restores it.

        Sequences ``[m, len(rows), k, act]`` lead to observations ``[m, len(rows), k, obs]``, in all environments or in
        ``rows``. Entry ``k`` is the state after actions 0 to ``k``; :meth:`step` observes it one control step later.

        Raises:
            ValueError: if the shape is wrong.
        """
        rows = np.arange(self.batch_size[0]) if rows is None else np.asarray(rows, dtype=np.int64)
        actions = np.asarray(actions, dtype=np.float64)
        if actions.ndim != 4 or actions.shape[1] != len(rows) or actions.shape[3] != self.task.action_dim:
            raise ValueError(
                f"actions must be [m, {len(rows)}, k, {self.task.action_dim}] [sequences, environments, control steps,"
                f" action], got shape {list(actions.shape)}"
            )
        present = [self.get_state(row) for row in rows]
        observations = np.empty((*actions.shape[:3], self.task.observation_dim))
        try:
            for sequence, observed in zip(actions, observations, strict=True):
                for row, state in zip(rows, present, strict=True):
                    self.set_state(row, state)
                for step in range(actions.shape[2]):
                    self._command(rows, sequence[:, step])
                    self._advance(rows)
                    observed[:, step] = self._observe(rows)
        finally:
            for row, state in zip(rows, present, strict=True):
                self.set_state(row, state)
        return observations
