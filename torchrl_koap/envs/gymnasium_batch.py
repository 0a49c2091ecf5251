# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs any Gymnasium environment as a batch of episodes, for rollouts of a trained policy."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
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

from torchrl_koap.data.formats.kinds import leaves, spread
from torchrl_koap.envs.gymnasium_episode import GymnasiumEpisode, ObservationError, entries_of, find_success_key, say
from torchrl_koap.files import some
from torchrl_koap.keys import ACTION, FAILED, MODE, OBSERVATION, SUCCESS
from torchrl_koap.tasks import Task
from torchrl_koap.vision.observer import STATE, Observer


@dataclass
class EpisodeRecord:
    """Counts clipped actions and errors in the episodes of all batches that share it."""

    actions: int = 0  # number of steps
    clipped: int = 0  # number of steps whose action was clipped to the environment's box
    clipped_columns: Counter[str] = field(default_factory=Counter)  # number of clipped steps per action column
    # ``seed``, ``step`` and ``error`` of every episode in which the environment raised one
    errors: list[dict[str, Any]] = field(default_factory=list)

    def faults(self) -> list[str]:
        """Returns a sentence about clipped actions, and one about errors, if there are any."""
        found = []
        if self.clipped:
            which = some([f"{name} {count}" for name, count in self.clipped_columns.most_common()])
            said = f"{self.clipped} of {self.actions} actions left the environment's box and were clipped to it"
            found.append(f"{said} (by column: {which})")
        if self.errors:
            said = some([f"seed {each['seed']}, step {each['step']}: {each['error']}" for each in self.errors])
            found.append(f"{len(self.errors)} episodes failed by an error of the environment: {said}")
        return found


class NamedColumns(gymnasium.ObservationWrapper):
    """Takes the columns ``names`` from a dictionary of numbers, in that order; ``read_minari`` names them alike.

    Raises:
        ObservationError: if the dictionary lacks one of the columns.
    """

    def __init__(self, env: gymnasium.Env, names: Sequence[str]):
        super().__init__(env)
        self.names = names
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (len(names),), np.float64)
        known = self._columns(create_zero_array(env.observation_space))
        if lacks := [name for name in names if name not in known]:
            has = some(list(known)) or "no numbers"
            raise ObservationError(
                f"its observation is a dictionary of {has}; it lacks the columns {some(lacks)}: convert the recordings"
                " with state_names of the dictionary, or register the environment with a wrapper that gives one flat"
                " array in the order of the recordings"
            )

    def observation(self, observation: Any) -> np.ndarray:
        """Returns the columns ``[obs]``."""
        columns = self._columns(observation)
        return np.concatenate([columns[name] for name in self.names])

    @staticmethod
    def _columns(observation: Any) -> dict[str, np.ndarray]:
        held = leaves(observation)
        numbers = [(name, values) for name, values in held if values.ndim < 2 and values.dtype.kind in "fiub"]
        return {name: column for entry, values in numbers for name, column in spread(entry, values[None]).items()}


class GymnasiumBatch(EnvBase):
    """Runs environments of one Gymnasium id in parallel; one whose episode is over waits for the others.

    So does one that TorchRL's mask ``_step`` leaves out. ``success`` stays True once it is reported
    (:class:`GymnasiumEpisode`). Actions are clipped to the environment's box. An environment that raises an error, or
    gives a wrong observation, ends its episode as failed (``failed``).

    Observations and actions are those of the data: the task's ``origins`` are subtracted from an environment's
    observations and added to its actions. Of a dictionary, the task's columns are taken by name.

    For a policy trained with cameras (``observe``), the environment's observation is a dictionary. Its uint8 pictures
    are frames of the cameras of the same name (a single one needs no matching name); its numbers are concatenated to
    the state.

    An episode is truncated after ``max_steps``, by default the environment's own limit, or the task's if it has none.
    With ``processes`` each environment has a process of its own; ``record`` collects clipped actions and errors.

    Raises:
        ValueError: if the environment does not exist, its observations or actions are no flat boxes of the task's
            widths, or ``info`` lacks the success key in a whole episode, of which 1,000 steps are tried.
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

        def make() -> gymnasium.Env:
            env = gymnasium.make(env_id, **(env_kwargs or {}))
            named = observe is None and isinstance(env.observation_space, gymnasium.spaces.Dict)
            return NamedColumns(env, task.observation_names) if named else env

        try:
            first = make()
        except Exception as error:
            absent = isinstance(error, gymnasium.error.UnregisteredEnv) and ":" not in env_id
            cure = f" Name the package that registers it: PACKAGE:{env_id}" if absent else ""
            raise ValueError(f"environment {env_id!r} cannot be made: {say(error)}{cure}") from error
        try:
            if observe is None:
                _check_box(env_id, "observation", first.observation_space, task.name, task.observation_dim)
            else:
                _check_entries(env_id, first.observation_space, observe)
            _check_box(env_id, "action", first.action_space, task.name, task.action_dim)
            self.own_limit = None if first.spec is None else first.spec.max_episode_steps
            self.success_key = find_success_key(env_id, first, success_key)
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
        begin = self._chosen(tensordict, "_reset")
        seen, _ = self._env.reset(seed=self._seeds, options={"begin": begin})
        for index in np.flatnonzero(begin):
            self._begun_with[index], self._seeds[index], self._steps[index] = self._seeds[index], None, 0
        for name in (*_ENDS, SUCCESS, FAILED):
            self._state[name] = self._state[name] & ~torch.from_numpy(begin).unsqueeze(-1)
        return self._leaves(seen)

    def _chosen(self, tensordict: TensorDictBase | None, mask: str) -> np.ndarray:
        """Returns which environments a mask of TorchRL chooses, bool ``[n]``: all without a mask."""
        chosen = None if tensordict is None else tensordict.get(mask, None)
        return np.ones(self.batch_size[0], bool) if chosen is None else chosen.flatten(1).any(1).cpu().numpy()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        waits = ~self._chosen(tensordict, "_step") & ~self._state["done"].squeeze(-1).numpy()
        if waits.any():  # those that are over wait anyway
            self._env.set_attr("waits", waits.tolist())
        seen, reward, _, _, info = self._env.step(tensordict.get(ACTION).detach().cpu().numpy() + self._added)
        self._steps += info["played"]
        self.record.actions += int(info["played"].sum())
        self.record.clipped += int(info["clipped"].any(-1).sum())
        columns = zip(self.task.action_names, info["clipped"].sum(0).tolist(), strict=True)
        self.record.clipped_columns.update({name: count for name, count in columns if count})
        failed = info["error"].astype(bool)
        self.record.errors += [
            {"seed": self._begun_with[index], "step": int(self._steps[index]), "error": info["error"][index]}
            for index in np.flatnonzero(failed)
        ]
        told = {name: info[name] for name in ("terminated", "truncated", SUCCESS)}
        told |= {"done": info["terminated"] | info["truncated"], FAILED: failed}
        for name, flags in told.items():  # an environment that waited keeps its own
            kept = self._state[name].squeeze(-1).numpy()
            self._state[name] = torch.from_numpy(np.where(info["played"], flags, kept)).unsqueeze(-1)
        return self._leaves(seen).set("reward", torch.from_numpy(reward).float().unsqueeze(-1))

    def _leaves(self, seen: Any) -> TensorDictBase:
        """Returns observations and the state of every episode."""
        if self._observe is not None:
            seen = np.stack([self._read(each) for each in iterate(self._env.observation_space, seen)])
        self._state[OBSERVATION] = torch.from_numpy((np.asarray(seen) - self._origin).astype(np.float32))
        return TensorDict({name: value.clone() for name, value in self._state.items()}, self.batch_size)

    def _read(self, observation: Any) -> np.ndarray:
        """Returns the task's observation ``[obs]`` from an environment's dictionary."""
        frames, numbers = _split_pictures(dict(entries_of(observation)))
        named = _frames_by_camera(frames, self._observe)
        state = np.concatenate([np.ravel(value) for value in numbers.values()]) if numbers else None
        return self._observe(named if state is None else {STATE: state, **named})

    def close(self, **kwargs: Any) -> None:
        """Closes the environments."""
        self._env.close()
        super().close(**kwargs)


# kind of space -> what it must be, and wrappers of Gymnasium that make it
_WANTED = {
    "observation": ("Box", "FlattenObservation, TransformObservation"),
    "action": ("Box of floats", "TransformAction"),
}
_ENDS = ("done", "terminated", "truncated")
# spawned processes import everything again and lack the environments that plugins have registered
_FORK = "fork" if sys.platform == "linux" else None


def _split_pictures(entries: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Splits the entries of an observation, or of its space, into pictures and numbers."""
    frames = {name: value for name, value in entries.items() if value.dtype == np.uint8 and len(value.shape) == 3}
    return frames, {name: value for name, value in entries.items() if name not in frames}


def _frames_by_camera(frames: Mapping[str, Any], observe: Observer) -> dict[str, Any]:
    cameras = list(observe.cameras)
    if len(cameras) == len(frames) == 1:
        return {cameras[0]: next(iter(frames.values()))}
    return {name: frames[name] for name in cameras if name in frames}


def _check_entries(env_id: str, space: gymnasium.Space, observe: Observer) -> None:
    frames, numbers = _split_pictures(dict(entries_of(space)))
    missing = [name for name in observe.cameras if name not in _frames_by_camera(frames, observe)]
    width = sum(int(np.prod(each.shape)) for each in numbers.values())
    if missing or width not in (observe.state_dim, 0):
        lacks = f"camera {missing[0]!r} has no picture" if missing else f"its numbers have {width} columns"
        raise ValueError(
            f"the observation of environment {env_id!r} is {space}: {lacks}; wanted uint8 pictures"
            f" {', '.join(observe.cameras)} and {observe.state_dim} columns of numbers"
        )


def _check_box(env_id: str, what: str, space: gymnasium.Space, task: str, width: int) -> None:
    fits = isinstance(space, gymnasium.spaces.Box) and space.shape == (width,)
    if not fits or what == "action" and np.dtype(space.dtype).kind != "f":  # whole numbers would be cut off
        kind, tools = _WANTED[what]
        raise ValueError(
            f"the {what} of environment {env_id!r} is {space}, task {task!r} has {width} columns: wanted a flat {kind}"
            f" of shape ({width},). Register the environment with a wrapper that gives it (gymnasium.wrappers: {tools})"
        )
