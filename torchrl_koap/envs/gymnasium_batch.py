# This source code is licensed under the MIT license found in the LICENSE file.
"""Any environment of Gymnasium as a batch of episodes in which a trained policy can be rolled out."""

from __future__ import annotations

import sys
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.vector.utils import iterate
from gymnasium.wrappers.utils import create_zero_array
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_koap.files import some
from torchrl_koap.keys import ACTION, FAILED, MODE, OBSERVATION, SUCCESS
from torchrl_koap.tasks import Task
from torchrl_koap.vision.observer import STATE, Observer

SUCCESS_KEYS = ("is_success", "success")
_ROUNDING = 1e-6  # share of an action that float32 may put it beyond its box
_LONGEST_PROBE = 1000  # steps in which a success key that was asked for must come


class ObservationError(ValueError):
    """An environment gives no observation, or one of another shape than its space, or with NaN or infinity."""


class GymnasiumEpisode(gymnasium.Wrapper):
    """Plays one episode of an environment after each reset, then repeats its last observation.

    A vector environment therefore never resets it; ``index`` is its place there. ``info`` holds ``terminated``,
    ``truncated`` and ``over``; whether the step was ``played`` and its action ``clipped`` to the box; ``success``; and
    as ``error`` what the environment raised in this step or at the reset, which truncates the episode. A wrong
    observation (:class:`ObservationError`), whose columns have ``names``, is such an error.

    Success is what the entry ``success_key`` of the environment's ``info`` says, by default ``is_success`` or
    ``success`` where there is one, else an episode that terminates with a positive reward.
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
        self._last = create_zero_array(env.observation_space)
        self._error, self._steps, self._over, self._success = "", 0, True, False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begins an episode, unless ``options["begin"]``, a bool for each environment, says otherwise."""
        if options is None or options["begin"][self.index]:
            self._error, self._steps, self._over, self._success = "", 0, False, False
            try:
                self._take(_begin(self.env, seed))
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
                seen, given, terminated, truncated, info = self.env.step(inside)
                self._take(seen)
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

    def _take(self, seen: Any) -> None:
        _check_shape(seen, self._last)
        for entry, values in _entries(seen):
            for column in np.flatnonzero(~np.isfinite(values)):
                said = "NaN" if np.isnan(np.ravel(values)[column]) else "infinite"
                name = self.names[column] if self.names else entry
                raise ObservationError(f"observation is {said} in column {column} ({name})")
        self._last = seen

    def _succeeded(self, info: Mapping[str, Any], reward: float, terminated: bool) -> bool:
        found = success_entry(info, self.success_key)
        if found is None:
            return self.success_key is None and terminated and reward > 0
        said = info[found]
        return said.strip().lower() in ("true", "1") if isinstance(said, str) else bool(np.any(said))


def success_entry(info: Container[str], success_key: str | None) -> str | None:
    """Returns the entry of ``info`` that says whether the task is done, None where there is none."""
    return next((key for key in (SUCCESS_KEYS if success_key is None else (success_key,)) if key in info), None)


def _said(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


@dataclass
class EpisodeRecord:
    """What happened in the episodes of all batches that were given it."""

    actions: int = 0  # steps that were played
    clipped: int = 0  # those whose action lay outside the environment's box and was clipped to it
    # ``seed``, ``step`` and ``error`` of every episode in which the environment raised one
    errors: list[dict[str, Any]] = field(default_factory=list)

    def faults(self) -> list[str]:
        """Returns a sentence about clipped actions, and one about errors, where there are any."""
        found = []
        if self.clipped:
            found.append(f"{self.clipped} of {self.actions} actions left the environment's box and were clipped to it")
        if self.errors:
            said = some([f"seed {each['seed']}, step {each['step']}: {each['error']}" for each in self.errors])
            found.append(f"{len(self.errors)} episodes failed by an error of the environment: {said}")
        return found


class GymnasiumBatch(EnvBase):
    """Environments of one Gymnasium id side by side; one whose episode is over waits for the others.

    ``success`` stays True from the step on in which it is reported (:class:`GymnasiumEpisode`). Actions are clipped to
    the environment's box. An environment that raises an error, or gives a wrong observation, ends its episode as failed
    (``failed``).

    Observations and actions are those of the data: the task's ``origins`` are subtracted from what environments report
    and added to what they are told.

    Where the policy was trained with cameras (``observe``), the environment's observation is a dictionary: its uint8
    pictures are the frames of the cameras of their names (of the only one whatever their name), its numbers side by
    side the state.

    An episode is truncated after ``max_steps``, by default the environment's own limit, or the task's where it has
    none. With ``processes`` each environment has a process of its own; ``record`` is told of clipped actions and
    errors.

    Raises:
        ValueError: if there is no such environment, its observations or actions are no flat boxes of the task's
            widths, or ``info`` has no such success key in a whole episode, of which 1,000 steps are tried.
    """

    def __init__(
        self,
        env_id: str,
        task: Task,
        num_envs: int = 1,
        *,
        env_kwargs: Mapping[str, Any] | None = None,
        processes: bool = False,
        observe: Observer | None = None,
        success_key: str | None = None,
        max_steps: int | None = None,
        record: EpisodeRecord | None = None,
    ):
        super().__init__(batch_size=[num_envs])
        self.task, self._observe = task, observe
        self._origin, self._added = map(np.asarray, task.origins or (0.0, 0.0))
        self.record = EpisodeRecord() if record is None else record
        make = partial(gymnasium.make, env_id, **(env_kwargs or {}))
        try:
            first = make()
        except Exception as error:
            raise ValueError(f"environment {env_id!r} cannot be made: {_said(error)}") from error
        try:
            if observe is None:
                _check_box(env_id, "observation", first.observation_space, task.name, task.observation_dim)
            else:
                _check_entries(env_id, first.observation_space, observe)
            _check_box(env_id, "action", first.action_space, task.name, task.action_dim)
            self.own_limit = None if first.spec is None else first.spec.max_episode_steps
            self.success_key = _probe(env_id, first, success_key)
        finally:
            first.close()
        self.max_steps = max_steps or self.own_limit or task.max_steps
        names = task.observation_names if observe is None else ()
        options: dict[str, Any] = {"max_steps": self.max_steps, "success_key": success_key, "names": names}
        vector = partial(AsyncVectorEnv, context=_FORK) if processes else SyncVectorEnv
        episodes = [lambda index=index: GymnasiumEpisode(make(), index, **options) for index in range(num_envs)]
        self._env = vector(episodes, copy=False)
        self._seeds: list[int | None] = [None] * num_envs
        self._begun_with = list(self._seeds)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        shape, flag = self.batch_size, (num_envs, 1)
        self.observation_spec = Composite(
            {
                OBSERVATION: Unbounded((*shape, task.observation_dim)),
                SUCCESS: Binary(n=1, shape=flag, dtype=torch.bool),
                FAILED: Binary(n=1, shape=flag, dtype=torch.bool),
                MODE: Unbounded(flag, dtype=torch.int64),
            },
            shape=shape,
        )
        self.action_spec = Unbounded((*shape, task.action_dim))
        self.reward_spec = Unbounded(flag)
        done = Categorical(2, flag, dtype=torch.bool)
        self.done_spec = Composite({name: done.clone() for name in _ENDS}, shape=shape)
        self._state = {**self.observation_spec.zero().to_dict(), **self.done_spec.zero().to_dict()}

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Seeds the next reset of every environment, so that an episode does not depend on the batch it runs in."""
        self._seeds = [int(seed) for seed in seeds]

    def _set_seed(self, seed: int | None) -> None:
        self._seeds = [None if seed is None else seed + index for index in range(self.batch_size[0])]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        begin = np.ones(self.batch_size[0], bool) if chosen is None else chosen.flatten(1).any(1).cpu().numpy()
        seen, _ = self._env.reset(seed=self._seeds, options={"begin": begin})
        for index in np.flatnonzero(begin):
            self._begun_with[index], self._seeds[index], self._steps[index] = self._seeds[index], None, 0
        for name in (*_ENDS, SUCCESS, FAILED):
            self._state[name] = self._state[name] & ~torch.from_numpy(begin).unsqueeze(-1)
        return self._leaves(seen)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen, reward, _, _, told = self._env.step(tensordict.get(ACTION).cpu().numpy() + self._added)
        self._steps += told["played"]
        self.record.actions += int(told["played"].sum())
        self.record.clipped += int(told["clipped"].sum())
        failed = told["error"].astype(bool)
        self.record.errors += [
            {"seed": self._begun_with[index], "step": int(self._steps[index]), "error": told["error"][index]}
            for index in np.flatnonzero(failed)
        ]
        ends = {"done": told["over"], FAILED: failed} | {name: told[name] for name in (*_ENDS[1:], SUCCESS)}
        self._state |= {name: torch.from_numpy(flags.astype(bool)).unsqueeze(-1) for name, flags in ends.items()}
        return self._leaves(seen).set("reward", torch.from_numpy(reward).float().unsqueeze(-1))

    def _leaves(self, seen: Any) -> TensorDictBase:
        """What was seen and the state of every episode, as leaves."""
        if self._observe is not None:
            seen = np.stack([self._read(each) for each in iterate(self._env.observation_space, seen)])
        self._state[OBSERVATION] = torch.from_numpy((np.asarray(seen) - self._origin).astype(np.float32))
        return TensorDict({name: value.clone() for name, value in self._state.items()}, self.batch_size)

    def _read(self, observation: Any) -> np.ndarray:
        """The task's observation ``[obs]`` of an environment's dictionary."""
        frames, numbers = _sorted(dict(_entries(observation)))
        named = _named(frames, self._observe)
        state = np.concatenate([np.ravel(value) for value in numbers.values()]) if numbers else None
        return self._observe(named if state is None else {STATE: state, **named})

    def close(self, **kwargs: Any) -> None:
        """Closes the environments."""
        self._env.close()
        super().close(**kwargs)


_ENDS = ("done", "terminated", "truncated")
# a process that is spawned imports everything again, and knows no environment that a plugin has registered
_FORK = "fork" if sys.platform == "linux" else None


def _probe(env_id: str, env: gymnasium.Env, success_key: str | None) -> str | None:
    """The entry of ``info`` that says whether the task is done, None where none of a first step does.

    The one that was asked for may come as late as the end of an episode.
    """
    space: Any = env.action_space
    action = np.clip(np.zeros(space.shape), space.low, space.high).astype(space.dtype)
    shapes, entries = create_zero_array(env.observation_space), set[str]()
    try:
        _check_shape(_begin(env, seed=0), shapes)
        for _ in range(1 if success_key is None else _LONGEST_PROBE):
            seen, _, terminated, truncated, info = env.step(action)
            _check_shape(seen, shapes)
            entries |= set(info)
            if terminated or truncated or success_entry(entries, success_key):
                break
    except ObservationError as error:
        raise ValueError(f"environment {env_id!r}: {error}") from error
    except Exception:  # the episodes tell
        return success_key
    found = success_entry(entries, success_key)
    if found is None and success_key is not None:
        has = ", ".join(sorted(map(str, entries))) or "nothing"
        raise ValueError(f"info of environment {env_id!r} has no {success_key!r}, it has {has}")
    return found


def _begin(env: gymnasium.Env, seed: int | None) -> Any:
    """The first observation of an episode."""
    given: Any = env.reset(seed=seed)
    if not isinstance(given, tuple) or len(given) != 2:
        raise ObservationError(f"reset() must return an observation and an info, got {type(given).__name__}")
    return given[0]


def _check_shape(seen: Any, wanted: Any) -> None:
    found = dict(_entries(seen))
    for entry, values in _entries(wanted):
        shape, name = np.shape(found.get(entry)), f" {entry!r}" if isinstance(wanted, Mapping) else ""
        if shape != np.shape(values):
            raise ObservationError(f"observation{name} has shape {shape}, wanted {np.shape(values)}")


def _entries(observation: Any, name: str = "pixels") -> Iterator[tuple[str, Any]]:
    """Entries of a dictionary in dictionaries by the name of the innermost."""
    if isinstance(observation, Mapping):
        for inner, value in observation.items():
            yield from _entries(value, inner)
    else:
        yield name, observation


def _sorted(entries: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Pictures, and numbers, of an observation or of its space."""
    frames = {name: value for name, value in entries.items() if value.dtype == np.uint8 and len(value.shape) == 3}
    return frames, {name: value for name, value in entries.items() if name not in frames}


def _named(frames: Mapping[str, Any], observe: Observer) -> dict[str, Any]:
    cameras = list(observe.cameras)
    if len(cameras) == len(frames) == 1:
        return {cameras[0]: next(iter(frames.values()))}
    return {name: frames[name] for name in cameras if name in frames}


def _check_entries(env_id: str, space: gymnasium.Space, observe: Observer) -> None:
    spaces = dict(_entries(space.spaces if isinstance(space, gymnasium.spaces.Dict) else space))
    frames, numbers = _sorted(spaces)
    missing = [name for name in observe.cameras if name not in _named(frames, observe)]
    width = sum(int(np.prod(each.shape)) for each in numbers.values())
    if missing or width not in (observe.state_dim, 0):
        lacks = f"camera {missing[0]!r} has no picture" if missing else f"its numbers have {width} columns"
        raise ValueError(
            f"the observation of environment {env_id!r} is {space}: {lacks}; wanted uint8 pictures"
            f" {', '.join(observe.cameras)} and {observe.state_dim} columns of numbers"
        )


def _check_box(env_id: str, what: str, space: gymnasium.Space, task: str, width: int) -> None:
    if not isinstance(space, gymnasium.spaces.Box) or space.shape != (width,):
        raise ValueError(
            f"the {what} of environment {env_id!r} is {space}, task {task!r} has {width} columns: wanted a flat Box of"
            f" shape ({width},). Register the environment with a wrapper that gives it"
            " (gymnasium.wrappers.FlattenObservation, TransformObservation)"
        )
