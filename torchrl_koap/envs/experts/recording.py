# This source code is licensed under the MIT license found in the LICENSE file.
"""Plays one attempt of a scripted expert at a batch of episodes, and records it.

D3IL's environments are recorded as by D3IL's recorder: after the first substep of a control step, so that positions are
1 ms newer than the observed ones. Of other environments, observations and actions are recorded.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from torchrl_koap import keys
from torchrl_koap.data.d3il.conversion import CONVERTERS, Converter
from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.experts.disturbances import Disturbances
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import Task, get_task

FAULTS = {  # reasons to discard an attempt; the first that applies is reported
    "collision": "something forbidden was touched",
    "unfinished": "no success within the step limit",
    "mode": "success in another mode than asked for",
    "close": "passed nearer than any human demonstration",
    "slow": "took longer than any human demonstration",
}


class Attempt(NamedTuple):
    """The recorded data of one attempt."""

    frames: np.ndarray  # [T, obs]
    actions: np.ndarray  # [T - 1, act]
    steps: int  # control steps; one more than actions in D3IL's log, which begins with the state after the first one
    fault: str = ""  # what went wrong, one of FAULTS; empty if nothing did


class Expert(abc.ABC):
    """Plays a batch of ``n`` episodes of a task; ``Task.expert`` names the subclass.

    Each episode has a mode and a seed, an integer or a sequence of integers as for ``numpy.random.default_rng``; in a
    task with bodies also a context ``[bodies, 3]``: x, y (m), yaw (rad). Its random numbers come from its seed only,
    so it does not depend on the rest of the batch.
    """

    TASK: str  # name of the task
    embodiments: tuple[str, ...] = ()  # of demonstrations in view of a camera
    # recordings beyond these limits are discarded, like those without success or in another mode than asked for
    most_rows: int | None = None  # largest number of control steps
    least_clearance = 0.0  # smallest distance from forbidden bodies (m)

    def __init__(self, modes: Sequence[int], contexts: np.ndarray | None, seeds: Sequence):
        self.task = get_task(self.TASK)
        self.finished = np.zeros(len(modes), dtype=bool)  # episodes that the expert has ended

    @abc.abstractmethod
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Returns actions ``[n, act]`` for observations, float64 ``[n, obs]``; called once per control step."""

    def touching(self, env: Any) -> np.ndarray:
        """Returns which episodes touch a forbidden body, bool ``[n]``."""
        return np.zeros(env.batch_size[0], dtype=bool)

    @staticmethod
    def clearance(frames: np.ndarray) -> float:
        """Returns the least distance of a recording ``[T, obs]`` from forbidden bodies (m)."""
        return np.inf


def ar1_noise(
    generator: np.random.Generator, memory: float, deviation: float, size: int | tuple[int, ...]
) -> np.ndarray:
    """Draws the drift of a hand: noise ``[*size]``, steps first, from an autoregressive process of order one.

    Its standard deviation is ``deviation`` from the first step on; after ``memory`` steps the autocorrelation is 1/e.
    """
    keep = np.exp(-1 / memory)
    values = generator.normal(0, deviation, size)
    values[1:] *= np.sqrt(1 - keep**2)
    for step in range(1, len(values)):
        values[step] += keep * values[step - 1]
    return values


def expert_of(task: Task) -> type[Expert]:
    """Returns the task's scripted expert."""
    if task.expert is None:
        raise ValueError(f"task {task.name!r} has no scripted expert (Task.expert is None): nothing can be recorded")
    return resolve(task.expert, f"expert of task {task.name!r}")


def play(
    env: Any,
    task: Task,
    modes: Sequence[int],
    contexts: np.ndarray | None,
    seeds: Sequence,
    progress: Callable[[int], None],
    disturbances: Disturbances,
) -> list[Attempt]:
    """Plays one attempt at as many episodes as there are modes, in the first environments of a batch; the others idle.

    ``contexts`` are those of all environments; ``progress`` is called with the number of episodes that are over.
    """
    count, playing = env.batch_size[0], len(modes)
    placed = None if contexts is None else contexts[:playing]
    expert = expert_of(task)(modes=modes, contexts=placed, seeds=seeds)
    converter = CONVERTERS.get(task.source) if isinstance(env, ManipulationEnv) else None
    active = np.arange(count) < playing
    data = env.reset() if contexts is None else env.reset(contexts=contexts)
    frames, actions, logs = [data[keys.OBSERVATION].numpy().copy()], [], []
    touched, lengths = np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
    success, reached = np.zeros(count, dtype=bool), np.full(count, -1)
    for _ in range(env.max_steps):
        action = np.zeros((count, task.action_dim))
        action[:playing] = disturbances.disturb(expert.act(frames[-1][:playing]))
        # environments may skip finished episodes; what they return for them is not used
        step = data.set(keys.ACTION, torch.from_numpy(action)).set("_step", torch.from_numpy(active[:, None].copy()))
        data = env.step(step)["next"].clone()
        frames.append(data[keys.OBSERVATION].numpy().copy())
        actions.append(action)
        if converter is not None:
            logs.append(env.raw_log())
        lengths += active
        success = np.where(active, data[keys.SUCCESS].squeeze(-1).numpy(), success)
        reached = np.where(active, task.modes.index_of(data[keys.MODE]).numpy(), reached)
        touched |= active & expert.touching(env)
        active[:playing] &= ~expert.finished
        active &= ~touched
        progress(int(playing - active.sum() - touched.sum()))
        if not active.any():
            break
    results = []
    for row in range(playing):
        length = int(lengths[row])
        if converter is None:
            seen, done = np.stack(frames)[: length + 1, row], np.stack(actions)[:length, row]
        else:
            seen, done = _converted(converter, logs[:length], row)
        faults = {
            "collision": touched[row],
            "unfinished": active[row] or not success[row],
            "mode": reached[row] != modes[row],
            "close": expert.clearance(seen) < expert.least_clearance,
            "slow": expert.most_rows is not None and length > expert.most_rows,
        }
        fault = next((name for name in FAULTS if faults[name]), "")
        results.append(Attempt(seen, done, length, fault))
    return results


def _converted(
    converter: Converter, logs: Sequence[tuple[dict, np.ndarray]], row: int
) -> tuple[np.ndarray, np.ndarray]:
    """Converts the log of D3IL's recorder to frames and actions of an episode, as its files are converted."""
    robot = {name: np.stack([log[name][row] for log, _ in logs]) for name in converter.robot}
    poses = np.stack([poses[row] for _, poses in logs], axis=1)  # [objects, T, 7]
    each = zip(converter.objects, poses, strict=True)
    objects = {name: {"pos": own[:, :3], "quat": own[:, 3:]} for name, own in each}
    return converter.convert(robot, objects)
