# This source code is licensed under the MIT license found in the LICENSE file.
"""One attempt of a scripted expert at a batch of episodes, and what is kept of it.

What an expert (``Task.expert``) has to offer::

    __init__          (modes=, contexts=, seeds=) a mode, a context [bodies, 3] and a seed per episode, contexts=None in
                      a task without bodies
    act(observation)  float64 [n, obs] to the next actions [n, act], once per control step
    finished          bool [n]: which episodes are over for the expert
    rules             RecordingRules, optional

What an environment has to offer is told in :mod:`torchrl_koap.envs.registry`. One with ``raw_log()``, of a task with a
converter, is recorded as D3IL does it (:class:`~torchrl_koap.data.RawEpisode`), any other one as what it observed and
what was done (:class:`PlainEpisode`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchrl_koap import keys
from torchrl_koap.data import RawEpisode
from torchrl_koap.data.d3il.conversion import get_converter
from torchrl_koap.envs.contexts import yaw_quaternions
from torchrl_koap.envs.experts.disturbances import Disturbances
from torchrl_koap.envs.registry import mode_index_of
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import Task

FAULTS = ("collision", "unfinished", "mode", "close", "slow")


@dataclass(frozen=True)
class PlainEpisode:
    """What an environment observed and what was done.

    Args:
        observation (np.ndarray): ``[T + 1, obs]``.
        action (np.ndarray): ``[T, act]``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.envs.experts.recording import PlainEpisode
        >>> len(PlainEpisode(observation=np.zeros((41, 4)), action=np.zeros((40, 2))))
        40
    """

    observation: np.ndarray
    action: np.ndarray

    def __len__(self) -> int:
        return len(self.action)


Episode = RawEpisode | PlainEpisode


@dataclass(frozen=True)
class RecordingRules:
    """Which recordings of an expert are discarded, besides those without success or in another mode than asked for.

    Args:
        most_rows (int, optional): longer recordings are discarded. Default: none is.
        touching (callable, optional): from the environment to where something forbidden is touched, bool ``[n]``.
        clearance (callable, optional): from a recording to its least distance to what must not be touched (m).
        least_clearance (float): nearer recordings are discarded (m).

    Examples:
        >>> from torchrl_koap.envs.experts.recording import RecordingRules
        >>> RecordingRules(most_rows=399).least_clearance
        0.0
    """

    most_rows: int | None = None
    touching: Callable[[Any], np.ndarray] | None = None
    clearance: Callable[[Any], float] | None = None
    least_clearance: float = 0.0


def expert_of(task: Task) -> type:
    """The task's scripted expert.

    Args:
        task (Task): the task.

    Raises:
        ValueError: if it has none.
    """
    if task.expert is None:
        raise ValueError(f"task {task.name!r} has no scripted expert (Task.expert is None): nothing can be recorded")
    return resolve(task.expert, f"expert of task {task.name!r}")


def play(
    env: Any,
    task: Task,
    rows: np.ndarray,
    modes: Sequence[int],
    contexts: np.ndarray | None,
    seeds: Sequence,
    progress: Callable[[int], None],
    *,
    rules: RecordingRules | None = None,
    disturbances: Disturbances | None = None,
) -> list[tuple[Episode | None, str]]:
    """Plays one attempt of the episodes ``rows``.

    Args:
        env (EnvBase): one environment per episode of the recording.
        task (Task): the task.
        rows (np.ndarray): episodes to play.
        modes (sequence of int): mode asked for in each of them.
        contexts (np.ndarray, optional): contexts of all episodes of the environment.
        seeds (sequence): seed of each episode that is played.
        progress (callable): called with the number of episodes that are over.

    Keyword Args:
        rules (RecordingRules, optional): what is discarded. Default: the expert's own.
        disturbances (Disturbances, optional): what changes the actions of the episodes that are played.

    Returns:
        list: for each episode its recording and ``""``, or None and what went wrong, one of ``FAULTS``.
    """
    count, make = env.batch_size[0], expert_of(task)
    rules = rules or getattr(make, "rules", RecordingRules())
    placed = None if contexts is None else contexts[rows]
    expert = make(modes=modes, contexts=placed, seeds=seeds)
    recorder = _RawRecorder(task) if task.converter is not None and hasattr(env, "raw_log") else _PlainRecorder()
    active = np.zeros(count, dtype=bool)
    active[rows] = True
    data = env.reset() if contexts is None else env.reset(contexts=contexts)
    index_of, touched, lengths = mode_index_of(task), np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
    success, reached = np.zeros(count, dtype=bool), np.full(count, -1)
    for _ in range(env.max_steps):
        observation = data[keys.OBSERVATION].numpy()
        action = np.zeros((count, task.action_dim))
        wanted = expert.act(observation[rows])
        action[rows] = wanted if disturbances is None else disturbances.disturb(wanted)
        # an environment may leave alone those that are over; what it does with them is not looked at
        step = data.set(keys.ACTION, torch.from_numpy(action)).set("_step", torch.from_numpy(active[:, None].copy()))
        data = env.step(step)["next"].clone()
        recorder.add(env, observation, action, data[keys.OBSERVATION].numpy())
        lengths += active
        success = np.where(active, data[keys.SUCCESS].squeeze(-1).numpy(), success)
        reached = np.where(active, index_of(data[keys.MODE]).numpy(), reached)
        if rules.touching is not None:
            touched |= active & rules.touching(env)
        active[rows] &= ~expert.finished
        active &= ~touched
        progress(int(len(rows) - active[rows].sum() - touched.sum()))
        if not active.any():
            break
    results = []
    for index, row in enumerate(rows):
        episode = recorder.episode(row, lengths[row], None if placed is None else placed[index])
        faults = {
            "collision": touched[row],
            "unfinished": active[row] or not success[row],
            "mode": reached[row] != modes[index],
            "close": rules.clearance is not None and rules.clearance(episode) < rules.least_clearance,
            "slow": rules.most_rows is not None and len(episode) > rules.most_rows,
        }
        fault = next((name for name in FAULTS if faults[name]), "")
        results.append((None if fault else episode, fault))
    return results


class _PlainRecorder:
    """Keeps what was observed and done."""

    def __init__(self):
        self._frames: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []

    def add(self, env: Any, observation: np.ndarray, action: np.ndarray, following: np.ndarray) -> None:
        self._frames = self._frames or [observation.copy()]
        self._frames.append(following.copy())
        self._actions.append(action)

    def episode(self, row: int, length: int, context: np.ndarray | None) -> PlainEpisode:
        frames = np.stack([frame[row] for frame in self._frames[: length + 1]])
        return PlainEpisode(frames, np.stack([action[row] for action in self._actions[:length]]))


class _RawRecorder:
    """Keeps what D3IL's recorder logs."""

    def __init__(self, task: Task):
        self._names = get_converter(task.name).objects
        self._logs: list[tuple[dict, dict]] = []

    def add(self, env: Any, observation: np.ndarray, action: np.ndarray, following: np.ndarray) -> None:
        self._logs.append((env.raw_log(), env.raw_objects()))

    def episode(self, row: int, length: int, context: np.ndarray | None) -> RawEpisode:
        logs = self._logs[:length]
        robot = {name: np.stack([log[name][row] for log, _ in logs]) for name in logs[0][0]}
        # simulated time, so that files are repeatable
        robot["wall_clock"] = np.rint(robot["time_stamp"] * 1e9).astype(np.int64)
        objects = {}
        for name, own in zip(self._names, logs[0][1], strict=True):
            poses = np.stack([poses[own][row] for _, poses in logs])
            objects[name] = {"sim_step": robot["sim_step"], "pos": poses[:, :3], "quat": poses[:, 3:]}
        return RawEpisode(robot=robot, objects=objects, context=None if context is None else _raw_context(context))


def _raw_context(context: np.ndarray) -> list[list[np.ndarray]]:
    """D3IL's way to write a context: position and yaw in deg, and a quaternion, for every object."""
    return [
        [np.array([x, y, math.degrees(yaw)]), quaternion]
        for (x, y, yaw), quaternion in zip(context, yaw_quaternions(context[:, 2]), strict=True)
    ]
