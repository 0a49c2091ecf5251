# This source code is licensed under the MIT license found in the LICENSE file.
"""What would happen: action sequences tried in a simulation that is put back afterwards."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch

from torchrl_koap.tasks import Task


class _Simulated(Protocol):
    """What looking ahead asks of the environment that it is mixed into."""

    batch_size: torch.Size
    task: Task

    def get_state(self, row: int) -> dict[str, Any]: ...

    def set_state(self, row: int, state: dict[str, Any]) -> None: ...

    def _command(self, rows: np.ndarray, action: np.ndarray) -> None: ...

    def _advance(self, rows: np.ndarray) -> None: ...

    def _observe(self, rows: np.ndarray) -> np.ndarray: ...


class Foresight:
    """Base of :class:`~torchrl_koap.envs.base.ManipulationEnv` that looks ahead with the simulation itself.

    Uses the environment's hooks ``_command``, ``_advance`` and ``_observe``, and its ``get_state`` and ``set_state``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.envs import AvoidingEnv
        >>> env = AvoidingEnv(num_envs=2)
        >>> _ = env.reset()
        >>> held, pushed = env.foresee(np.array([np.zeros((2, 6, 2)), np.full((2, 6, 2), 0.01)]))
        >>> held.shape, bool((pushed[:, -1, 2:] > held[:, -1, 2:] + 0.005).all())
        ((2, 6, 4), True)
    """

    def foresee(self: _Simulated, actions: np.ndarray, rows: np.ndarray | None = None) -> np.ndarray:
        """States after each of the next control steps under given actions; the present stays as it is.

        What comes back is not one control step old as what :meth:`step` observes: entry ``k`` is the state that the
        actions 0 to ``k`` lead to, which an episode would observe with the observation after next.

        Args:
            actions (np.ndarray): sequences to try ``[m, len(rows), k, act]``.
            rows (np.ndarray, optional): which environments. Default: all.

        Returns:
            np.ndarray: observations ``[m, len(rows), k, obs]``.

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
        foreseen = np.empty((*actions.shape[:3], self.task.observation_dim))
        try:
            for sequence, seen in zip(actions, foreseen, strict=True):
                for row, state in zip(rows, present, strict=True):
                    self.set_state(row, state)
                for step in range(actions.shape[2]):
                    self._command(rows, sequence[:, step])
                    self._advance(rows)
                    seen[:, step] = self._observe(rows)
        finally:
            for row, state in zip(rows, present, strict=True):
                self.set_state(row, state)
        return foreseen
