# This source code is licensed under the MIT license found in the LICENSE file.
"""An environment of Gymnasium that plays one episode and waits: actions in its box, ends, success and errors told."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np

SUCCESS_KEYS = ("is_success", "success")
_ROUNDING = 1e-6  # share of an action that float32 may put it beyond its box


class GymnasiumEpisode(gymnasium.Wrapper):
    """Plays one episode of an environment after each reset, then repeats its last observation.

    A vector environment therefore never resets it; ``index`` is its place there. ``info`` holds ``terminated``,
    ``truncated`` and ``over``; whether the step was ``played`` and its action ``clipped`` to the box; ``success``; and
    as ``error`` what the environment raised in this step or at the reset, which truncates the episode.

    Success is what the entry ``success_key`` of the environment's ``info`` says, by default ``is_success`` or
    ``success`` where there is one, else an episode that terminates with a positive reward.
    """

    def __init__(self, env: gymnasium.Env, index: int, *, max_steps: int, success_key: str | None = None):
        super().__init__(env)
        self.index, self.max_steps, self.success_key = index, max_steps, success_key
        space = env.observation_space
        nothing = gymnasium.vector.utils.create_empty_array(space, n=1, fn=np.zeros)
        self._last = next(iter(gymnasium.vector.utils.iterate(gymnasium.vector.utils.batch_space(space, 1), nothing)))
        self._error, self._steps, self._over, self._success = "", 0, True, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode, unless ``options["begin"]``, a bool for each environment, says otherwise."""
        if options is None or options["begin"][self.index]:
            self._error, self._steps, self._over, self._success = "", 0, False, False
            try:
                self._last = self.env.reset(seed=seed)[0]
            except Exception as error:  # told with the first step: an episode without a step has no outcome
                self._error = _said(error)
        return self._last, {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Plays a step, if the episode is not over; its ends are told in ``info`` alone."""
        told = {"played": not self._over, "clipped": False, "terminated": False, "truncated": self._over, "error": ""}
        reward = 0.0
        if not self._over:
            reward, ends = self._play(action)
            told |= ends
        return self._last, reward, False, False, told | {"over": self._over, "success": self._success}

    def _play(self, action: np.ndarray) -> tuple[float, dict[str, Any]]:
        space: Any = self.env.action_space
        inside = np.clip(action, space.low, space.high).astype(space.dtype)
        terminated, truncated, reward = False, True, 0.0
        if not self._error:
            try:
                self._last, given, terminated, truncated, info = self.env.step(inside)
                reward = float(given)
                self._success |= self._succeeded(info, reward, bool(terminated))
            except Exception as error:  # the episode has failed, the others go on
                self._error, terminated, truncated = _said(error), False, True
        self._steps += 1
        self._over = bool(terminated or truncated or self._steps >= self.max_steps)
        return reward, {
            "clipped": not np.allclose(inside, action, rtol=_ROUNDING, atol=_ROUNDING),
            "terminated": bool(terminated),
            "truncated": self._over and not terminated,
            "error": self._error,
        }

    def _succeeded(self, info: Mapping[str, Any], reward: float, terminated: bool) -> bool:
        """Whether a step reports success."""
        found = success_entry(info, self.success_key)
        if found is None:
            return self.success_key is None and terminated and reward > 0
        said = info[found]
        return said.strip().lower() in ("true", "1") if isinstance(said, str) else bool(np.any(said))


def success_entry(info: Mapping[str, Any], success_key: str | None) -> str | None:
    """Returns the entry of ``info`` that says whether the task is done, None where there is none."""
    return next((key for key in (SUCCESS_KEYS if success_key is None else (success_key,)) if key in info), None)


def _said(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
