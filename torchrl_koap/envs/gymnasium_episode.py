# This source code is licensed under the MIT license found in the LICENSE file.
"""Plays one episode of a Gymnasium environment: checks its observations; an error ends this episode alone."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers.utils import create_zero_array

SUCCESS_KEYS = ("is_success", "success")
_ROUNDING = 1e-6  # float32 may move an action this far beyond its box, relative and absolute
_BONUS = 2.0  # a final reward above this multiple of the largest earlier one means success
_LONGEST_PROBE = 1000  # steps within which the requested success key must appear


class ObservationError(ValueError):
    """Raised if an environment returns no observation, one of a wrong shape, or one with NaN or infinity."""


class GymnasiumEpisode(gymnasium.Wrapper):
    """Plays one episode of an environment after each reset, then repeats its last observation.

    A vector environment therefore never resets it; ``index`` is its place there. If ``waits`` is set, the next step
    leaves the episode as it is. ``info`` holds whether the step was ``played``, whether it ``terminated`` or
    ``truncated`` the episode, and which columns of its action were ``clipped`` to the box; ``success``; and ``error``,
    the environment's error in this step or at the reset, which truncates the episode. A wrong observation
    (:class:`ObservationError`) is such an error, which names the column by ``names``.

    Success is the entry ``success_key`` of the environment's ``info``; by default ``is_success`` or ``success``. If
    the default finds none, an episode succeeds if its last step terminates it with a positive reward above twice any
    earlier one. A positive reward alone is not enough: a walker has one in all steps, also when it falls.
    """

    def __init__(
        self,
        env: gymnasium.Env,
        index: int,
        *,
        max_steps: int,
        success_key: str | None = None,
        names: Sequence[str] = (),
    ):
        super().__init__(env)
        self.index, self.max_steps, self.success_key, self.names = index, max_steps, success_key, names
        self.waits = False
        self._last = create_zero_array(env.observation_space)
        self._error, self._steps, self._over, self._success, self._most = "", 0, True, False, 0.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode unless ``options["begin"]``, a bool per environment, is False for this one."""
        if options is None or options["begin"][self.index]:
            self._error, self._steps, self._over, self._success, self._most = "", 0, False, False, 0.0
            try:
                self._take(self.env.reset(seed=seed)[0])
            except Exception as error:  # reported by the first step: an episode without a step has no outcome
                self._error = f"reset: {say(error)}"
        return self._last, {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Plays a step if the episode is not over and does not wait; only ``info`` reports its end."""
        plays, self.waits = not (self._over or self.waits), False
        report = {"played": plays, "terminated": False, "truncated": False, "error": ""}
        report["clipped"], reward = np.zeros(self.env.action_space.shape, bool), 0.0
        if plays:
            reward, ends = self._play(action)
            report |= ends
        return self._last, reward, False, False, report | {"success": self._success}

    def _play(self, action: np.ndarray) -> tuple[float, dict[str, Any]]:
        space: Any = self.env.action_space
        inside = np.clip(action, space.low, space.high).astype(space.dtype)
        terminated, truncated, reward = False, True, 0.0
        if not self._error:
            try:
                seen, given, terminated, truncated, info = self.env.step(inside)
                self._take(seen)
                reward = float(given)
                self._success |= self._succeeded(info, reward, bool(terminated))
                self._most = max(self._most, reward)
            except Exception as error:  # this episode fails, the others go on
                self._error, terminated, truncated = say(error), False, True
        self._steps += 1
        self._over = bool(terminated or truncated or self._steps >= self.max_steps)
        return reward, {
            "clipped": ~np.isclose(inside, action, rtol=_ROUNDING, atol=_ROUNDING),
            "terminated": bool(terminated),
            "truncated": self._over and not terminated,
            "error": self._error,
        }

    def _take(self, seen: Any) -> None:
        _check_shape(seen, self._last)
        for entry, values in entries_of(seen):
            wrong = np.flatnonzero(~np.isfinite(values))
            if len(wrong):
                column = wrong[0]
                said = "NaN" if np.isnan(np.ravel(values)[column]) else "infinite"
                name = self.names[column] if self.names else entry
                raise ObservationError(f"observation is {said} in column {column} ({name})")
        self._last = seen

    def _succeeded(self, info: Mapping[str, Any], reward: float, terminated: bool) -> bool:
        found = success_entry(info, self.success_key)
        if found is None:
            return self.success_key is None and terminated and reward > _BONUS * self._most
        said = info[found]
        return said.strip().lower() in ("true", "1") if isinstance(said, str) else bool(np.any(said))


def success_entry(info: Container[str], success_key: str | None) -> str | None:
    """Returns the entry of ``info`` that says whether the task is done; None if there is none."""
    return next((key for key in (SUCCESS_KEYS if success_key is None else (success_key,)) if key in info), None)


def say(error: Exception) -> str:
    """Returns type and message of an error in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def find_success_key(env_id: str, env: gymnasium.Env, success_key: str | None) -> str | None:
    """Returns the entry of ``info`` that says whether the task is done; None if the first step has none.

    A requested key may appear as late as the end of an episode.
    """
    space: Any = env.action_space
    action = np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype)
    shapes, entries = create_zero_array(env.observation_space), set[str]()
    try:
        _check_shape(env.reset(seed=0)[0], shapes)
        for _ in range(1 if success_key is None else _LONGEST_PROBE):
            seen, _, terminated, truncated, info = env.step(action)
            _check_shape(seen, shapes)
            entries |= set(info)
            if terminated or truncated or success_entry(entries, success_key):
                break
    except ObservationError as error:
        raise ValueError(f"environment {env_id!r}: {error}") from error
    except Exception:  # the episodes report it
        return success_key
    found = success_entry(entries, success_key)
    if found is None and success_key is not None:
        has = ", ".join(sorted(map(str, entries))) or "nothing"
        raise ValueError(f"info of environment {env_id!r} has no {success_key!r}, it has {has}")
    return found


def _check_shape(seen: Any, wanted: Any) -> None:
    found = dict(entries_of(seen))
    for entry, values in entries_of(wanted):
        shape, name = np.shape(found.get(entry)), f" {entry!r}" if isinstance(wanted, Mapping) else ""
        if shape != np.shape(values):
            raise ObservationError(f"observation{name} has shape {shape}, wanted {np.shape(values)}")


def entries_of(observation: Any, name: str = "pixels") -> Iterator[tuple[str, Any]]:
    """Yields the entries of nested dictionaries by their innermost name."""
    if isinstance(observation, Mapping):
        for inner, value in observation.items():
            yield from entries_of(value, inner)
    else:
        yield name, observation
