# This source code is licensed under the MIT license found in the LICENSE file.
"""One attempt of a scripted expert at a batch of episodes, and what is kept of it.

An environment of D3IL's is recorded as D3IL's recorder does it: after the first substep of a control step, so that
positions are 1 ms newer than those that were observed. Any other one is recorded as what it observed and what was done.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from torchrl_koap import keys
from torchrl_koap.data.d3il.conversion import CONVERTERS, Converter, RawEpisode
from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.experts.disturbances import Disturbances
from torchrl_koap.envs.registry import mode_index_of
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import Task

FAULTS = {  # why an attempt is discarded; of several the first one is told
    "collision": "something forbidden was touched",
    "unfinished": "no success within the step limit",
    "mode": "success in another mode than asked for",
    "close": "passed nearer than any human demonstration",
    "slow": "took longer than any human demonstration",
}


class Attempt(NamedTuple):
    """What is kept of one attempt."""

    frames: np.ndarray  # [T, obs]
    actions: np.ndarray  # [T - 1, act]
    steps: int  # played; one more than actions in D3IL's log, whose first row is the state after the first of them
    fault: str = ""  # what went wrong, one of FAULTS; empty if nothing did


@dataclass(frozen=True)
class RecordingRules:
    """Which recordings of an expert are discarded, besides those without success or in another mode than asked for.

    Args:
        most_rows (int, optional): recordings of more control steps are discarded. Default: none is.
        touching (callable, optional): from the environment to where something forbidden is touched, bool ``[n]``.
        clearance (callable, optional): from the frames ``[T, obs]`` of a recording to its least distance to what must
            not be touched (m).
        least_clearance (float): nearer recordings are discarded (m).
    """

    most_rows: int | None = None
    touching: Callable[[Any], np.ndarray] | None = None
    clearance: Callable[[np.ndarray], float] | None = None
    least_clearance: float = 0.0


class Expert(abc.ABC):
    """Plays a batch of ``n`` episodes of a task; a subclass is named by ``Task.expert``.

    Args:
        modes (sequence of int): mode of each episode.
        contexts (np.ndarray, optional): context ``[n, bodies, 3]``: x, y (m), yaw (rad); None in a task without bodies.
        seeds (sequence): for each episode an integer or a sequence of integers, as for ``numpy.random.default_rng``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.envs.experts.recording import Expert
        >>> class Still(Expert):
        ...     def __init__(self, modes, contexts, seeds):
        ...         self.finished = np.ones(len(modes), dtype=bool)
        ...
        ...     def act(self, observation):
        ...         return np.zeros((len(observation), 2))
        >>> Still([0, 1], None, [0, 1]).act(np.zeros((2, 4))).shape
        (2, 2)
    """

    rules = RecordingRules()
    embodiments: tuple[str, ...] = ()  # of demonstrations before a camera
    finished: np.ndarray  # which episodes are over for the expert, bool [n]

    @abc.abstractmethod
    def __init__(self, modes: Sequence[int], contexts: np.ndarray | None, seeds: Sequence): ...

    @abc.abstractmethod
    def act(self, observation: np.ndarray) -> np.ndarray:
        """Decides actions ``[n, act]`` under observations, float64 ``[n, obs]``; called once per control step.

        Raises:
            ValueError: if the observations have another shape.
        """

    def _checked(self, observation: np.ndarray, columns: int) -> np.ndarray:
        """The observations in float64; refused if they are not ``[n, columns]``."""
        observation = np.asarray(observation, dtype=np.float64)
        wanted = (len(self.finished), columns)
        if observation.shape != wanted:
            raise ValueError(f"observation must have shape {list(wanted)}, got {list(observation.shape)}")
        return observation


def check_episodes(modes: Sequence, seeds: Sequence, contexts: Any = None, objects: int = 0) -> None:
    """Checks that every episode has a mode, a seed and, with objects, a context.

    Raises:
        ValueError: if there is no mode, or the numbers of modes, seeds and, with objects, contexts differ.
    """
    asked, got = "seeds", f"{len(modes)} modes and {len(seeds)} seeds"
    if objects:
        asked = f"contexts [n, {objects}, 3] and seeds"
        got = f"{len(modes)} modes, {len(seeds)} seeds and contexts of shape {list(np.shape(contexts))}"
    if not len(modes) or len(modes) != len(seeds) or (objects and np.shape(contexts) != (len(modes), objects, 3)):
        raise ValueError(f"as many {asked} as modes are needed, at least one, got {got}")


def ar1_noise(
    generator: np.random.Generator, memory: float, deviation: float, size: int | tuple[int, ...]
) -> np.ndarray:
    """Draws noise ``[*size]`` of an autoregressive process of order one in its steady state: a drifting hand.

    Args:
        generator (np.random.Generator): where the draws come from.
        memory (float): steps after which a share 1/e remains.
        deviation (float): standard deviation.
        size (int or tuple of int): number of steps, or a shape that begins with it.
    """
    keep = np.exp(-1 / memory)
    values = generator.normal(0, deviation, size)
    values[1:] *= np.sqrt(1 - keep**2)
    for step in range(1, len(values)):
        values[step] += keep * values[step - 1]
    return values


def expert_of(task: Task) -> type[Expert]:
    """Returns the task's scripted expert.

    Raises:
        ValueError: if it has none.
    """
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
    *,
    disturbances: Disturbances | None = None,
) -> list[Attempt]:
    """Plays one attempt at as many episodes as there are modes, in the first environments of a batch; the others idle.

    Args:
        env (EnvBase): the batch.
        task (Task): the task.
        modes (sequence of int): mode asked for in each episode.
        contexts (np.ndarray, optional): contexts of all environments.
        seeds (sequence): seed of each episode.
        progress (callable): called with the number of episodes that are over.
        disturbances (Disturbances, optional): what changes the actions.
    """
    count, playing = env.batch_size[0], len(modes)
    placed = None if contexts is None else contexts[:playing]
    expert = expert_of(task)(modes=modes, contexts=placed, seeds=seeds)
    rules = expert.rules
    converter = CONVERTERS.get(task.source) if isinstance(env, ManipulationEnv) else None
    recorder = _PlainRecorder() if converter is None else _RawRecorder(converter)
    active = np.arange(count) < playing
    data = env.reset() if contexts is None else env.reset(contexts=contexts)
    index_of, touched, lengths = mode_index_of(task), np.zeros(count, dtype=bool), np.zeros(count, dtype=np.int64)
    success, reached = np.zeros(count, dtype=bool), np.full(count, -1)
    for _ in range(env.max_steps):
        observation = data[keys.OBSERVATION].numpy()
        action = np.zeros((count, task.action_dim))
        wanted = expert.act(observation[:playing])
        action[:playing] = wanted if disturbances is None else disturbances.disturb(wanted)
        # an environment may leave alone those that are over; what it does with them is not looked at
        step = data.set(keys.ACTION, torch.from_numpy(action)).set("_step", torch.from_numpy(active[:, None].copy()))
        data = env.step(step)["next"].clone()
        recorder.add(env, observation, action, data[keys.OBSERVATION].numpy())
        lengths += active
        success = np.where(active, data[keys.SUCCESS].squeeze(-1).numpy(), success)
        reached = np.where(active, index_of(data[keys.MODE]).numpy(), reached)
        if rules.touching is not None:
            touched |= active & rules.touching(env)
        active[:playing] &= ~expert.finished
        active &= ~touched
        progress(int(playing - active.sum() - touched.sum()))
        if not active.any():
            break
    results = []
    for row in range(playing):
        frames, actions = recorder.episode(row, lengths[row])
        faults = {
            "collision": touched[row],
            "unfinished": active[row] or not success[row],
            "mode": reached[row] != modes[row],
            "close": rules.clearance is not None and rules.clearance(frames) < rules.least_clearance,
            "slow": rules.most_rows is not None and lengths[row] > rules.most_rows,
        }
        fault = next((name for name in FAULTS if faults[name]), "")
        results.append(Attempt(frames, actions, int(lengths[row]), fault))
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

    def episode(self, row: int, length: int) -> tuple[np.ndarray, np.ndarray]:
        frames = np.stack([frame[row] for frame in self._frames[: length + 1]])
        return frames, np.stack([action[row] for action in self._actions[:length]])


class _RawRecorder:
    """Keeps what D3IL's recorder logs, and converts it as its files are converted."""

    def __init__(self, converter: Converter):
        self._converter = converter
        self._logs: list[tuple[dict, dict]] = []

    def add(self, env: Any, observation: np.ndarray, action: np.ndarray, following: np.ndarray) -> None:
        self._logs.append((env.raw_log(), env.raw_objects()))

    def episode(self, row: int, length: int) -> tuple[np.ndarray, np.ndarray]:
        logs = self._logs[:length]
        robot = {name: np.stack([log[name][row] for log, _ in logs]) for name in self._converter.robot}
        objects = {}
        for name, own in zip(self._converter.objects, logs[0][1], strict=True):
            poses = np.stack([poses[own][row] for _, poses in logs])
            objects[name] = {"pos": poses[:, :3], "quat": poses[:, 3:]}
        return self._converter.convert(RawEpisode(robot=robot, objects=objects))
