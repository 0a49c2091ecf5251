# This source code is licensed under the MIT license found in the LICENSE file.
"""Any environment of Gymnasium as a batch of episodes in which a trained policy can be rolled out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_koap.keys import ACTION, MODE, OBSERVATION, SUCCESS
from torchrl_koap.tasks import Task
from torchrl_koap.vision.observer import STATE, Observer

SUCCESS_KEYS = ("is_success", "success")


class GymnasiumBatch(EnvBase):
    """Environments of one Gymnasium id side by side; one whose episode is over waits for the others.

    ``success`` stays True from the step on in which it is reported: by ``info[success_key]``; without a key by
    ``info["is_success"]`` or ``info["success"]`` where the environment has one of them, else by an episode that
    terminates with a positive reward. Actions are handed over unchanged.

    Where the policy was trained with cameras, the environment's observation is a dictionary: its uint8 pictures are the
    frames of the cameras of their names (of the only one whatever their name), its numbers side by side the state.

    Args:
        env_id (str): id of the environment, such as ``"my_package:Reach-v0"``, which imports ``my_package`` first.
        task (Task): the task that the policy was trained on: its numbers of observation and action columns.
        num_envs (int): number of episodes.
        observe (callable, optional): of a policy with cameras, see :class:`~torchrl_koap.vision.Observer`.
        success_key (str, optional): the entry of ``info`` that says whether the task is done.
        max_steps (int, optional): steps after which an episode is truncated. Default: the environment's own limit, or
            the task's where it has none.

    Raises:
        ValueError: if there is no such environment, or its observations or actions are no flat boxes of the task's
            widths; at the end of an episode, if ``info`` never had the success key.

    Examples:
        >>> from torchrl_koap.envs.gymnasium_batch import GymnasiumBatch
        >>> from torchrl_koap.tasks import Action, Task
        >>> task = Task(name="swing", observation_parts={"pole": 3}, actions={"torque": Action("N m")}, position="pole")
        >>> env = GymnasiumBatch("Pendulum-v1", task, 2)
        >>> env.reset()["observation"].shape, env.max_steps
        (torch.Size([2, 3]), 200)
    """

    def __init__(
        self,
        env_id: str,
        task: Task,
        num_envs: int = 1,
        *,
        observe: Observer | None = None,
        success_key: str | None = None,
        max_steps: int | None = None,
    ):
        super().__init__(batch_size=[num_envs])
        self.env_id, self.task, self.success_key, self._observe = env_id, task, success_key, observe
        try:
            self.envs = [gymnasium.make(env_id) for _ in range(num_envs)]
        except (gymnasium.error.Error, ImportError) as error:
            raise ValueError(f"environment {env_id!r} cannot be made: {error}") from error
        first = self.envs[0]
        if observe is None:
            _check_box(env_id, "observation", first.observation_space, task.name, task.observation_dim)
        else:
            _check_entries(env_id, first.observation_space, observe)
        _check_box(env_id, "action", first.action_space, task.name, task.action_dim)
        limit = None if first.spec is None else first.spec.max_episode_steps
        self.max_steps = max_steps or limit or task.max_steps
        self._seeds: list[int | None] = [None] * num_envs
        self._observation = np.zeros((num_envs, task.observation_dim), dtype=np.float32)
        self._success, self._over = np.zeros(num_envs, dtype=bool), np.zeros(num_envs, dtype=bool)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self.success_keys: set[str] = set()  # those that have occurred
        shape, flag = self.batch_size, (num_envs, 1)
        self.observation_spec = Composite(
            {
                OBSERVATION: Unbounded((*shape, task.observation_dim)),
                SUCCESS: Binary(n=1, shape=flag, dtype=torch.bool),
                MODE: Unbounded(flag, dtype=torch.int64),
            },
            shape=shape,
        )
        self.action_spec = Unbounded((*shape, task.action_dim))
        self.reward_spec = Unbounded(flag)
        done = Categorical(2, flag, dtype=torch.bool)
        self.done_spec = Composite({name: done.clone() for name in ("done", "terminated", "truncated")}, shape=shape)

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Seeds the next reset of every environment, so that an episode does not depend on the batch it runs in."""
        self._seeds = [int(seed) for seed in seeds]

    def _set_seed(self, seed: int | None) -> None:
        self._seeds = [None if seed is None else seed + index for index in range(len(self.envs))]

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        chosen = None if tensordict is None else tensordict.get("_reset", None)
        for index, env in enumerate(self.envs):
            if chosen is None or chosen[index].any():
                observation, _ = env.reset(seed=self._seeds[index])
                self._seeds[index] = None  # further episodes go on from there
                self._observation[index] = self._seen(observation)
                self._success[index], self._over[index], self._steps[index] = False, False, 0
        nothing = np.zeros(len(self.envs))
        return self._leaves({"terminated": nothing > 0, "truncated": nothing > 0})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        actions = tensordict.get(ACTION).cpu().numpy()
        reward = np.zeros(len(self.envs), dtype=np.float32)
        flags = {name: self._over.copy() for name in ("terminated", "truncated")}
        flags["terminated"][:] = False
        for index in np.flatnonzero(~self._over):
            env = self.envs[index]
            action = actions[index].astype(env.action_space.dtype)
            observation, reward[index], terminated, truncated, info = env.step(action)
            self._observation[index] = self._seen(observation)
            self._steps[index] += 1
            over = bool(terminated or truncated or self._steps[index] >= self.max_steps)
            self._success[index] |= self._succeeded(info, float(reward[index]), bool(terminated), over)
            self._over[index] = over
            flags["terminated"][index], flags["truncated"][index] = terminated, over and not terminated
        return self._leaves(flags, reward)

    def _seen(self, observation: Any) -> Any:
        """What an environment gives as the task's observation ``[obs]``."""
        if self._observe is None:
            return observation
        frames, numbers = _sorted(dict(_entries(observation)))
        named = _named(frames, self._observe)
        state = np.concatenate([np.ravel(value) for value in numbers.values()]) if numbers else None
        return self._observe(named if state is None else {STATE: state.astype(np.float32), **named})

    def _succeeded(self, info: dict[str, Any], reward: float, terminated: bool, over: bool) -> bool:
        """Whether a step reports success."""
        keys = SUCCESS_KEYS if self.success_key is None else (self.success_key,)
        found = next((key for key in keys if key in info), None)
        if found is not None:
            self.success_keys.add(found)
            if isinstance(info[found], str):
                return info[found].strip().lower() in ("true", "1")
            return bool(np.any(info[found]))
        if self.success_key is None:
            return terminated and reward > 0
        if over and not self.success_keys:
            has = ", ".join(sorted(map(str, info))) or "nothing"
            raise ValueError(f"info of environment {self.env_id!r} has no {self.success_key!r}, it has {has}")
        return False

    def _leaves(self, flags: dict[str, np.ndarray], reward: np.ndarray | None = None) -> TensorDictBase:
        flags = flags | {"done": self._over, SUCCESS: self._success}
        leaves = {name: torch.from_numpy(flag.copy()).unsqueeze(-1) for name, flag in flags.items()}
        leaves[OBSERVATION] = torch.from_numpy(self._observation.copy())
        leaves[MODE] = torch.zeros(len(self.envs), 1, dtype=torch.int64)
        if reward is not None:
            leaves["reward"] = torch.from_numpy(reward).unsqueeze(-1)
        return TensorDict(leaves, self.batch_size)

    def close(self, **kwargs: Any) -> None:
        """Closes the environments."""
        for env in self.envs:
            env.close()
        super().close(**kwargs)


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
