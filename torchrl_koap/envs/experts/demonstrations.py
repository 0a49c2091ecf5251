# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording demonstrations: scripted experts play the library's own environments, all episodes in one batch.

An attempt that touches what it must not, takes another mode than asked for, does not finish, or is unlike any human one
(all but touches, takes too long) is played again with other random draws, after four attempts from another context;
nothing else is selected, and every discarded attempt is counted in the report.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap.data import RawEpisode, flatten_trajectories, write_raw_episode
from torchrl_koap.data.d3il.conversion import get_converter
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.experts.recording import FAULTS, Episode, PlainEpisode, RecordingRules, expert_of, play
from torchrl_koap.envs.registry import make_env
from torchrl_koap.tasks import Task, get_task

MAX_ATTEMPTS = 20
BATCH_SIZE = 50  # episodes that are played at once: few enough that the first are over within seconds
_PER_CONTEXT = 4  # attempts before an episode gets another context
_CONTEXT_STREAM = 1  # keeps the draws of contexts apart from those of the players


class RecordingError(RuntimeError):
    """An episode whose expert failed in every attempt."""


@dataclass(frozen=True)
class RecordingReport:
    """What was recorded, and what it took.

    Args:
        task (str): name of the task.
        seed (int): seed of the recording.
        modes (list of int): mode of each demonstration as the environment saw it.
        rows (list of int): control steps of each demonstration.
        attempts (list of int): attempts each demonstration took, 1 if the first one was good.
        failures (dict): number of discarded attempts by reason: ``collision``, ``mode``, ``unfinished``,
            ``close`` (nearly touched a cylinder), ``slow``.
        num_modes (int): modes the task has.
        seconds (float): wall-clock time.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import RecordingReport
        >>> report = RecordingReport("avoiding", 0, modes=[3, 7], rows=[80, 95], attempts=[1, 2], failures={"mode": 1})
        >>> report.failed_attempts
        1
    """

    task: str
    seed: int
    modes: list[int]
    rows: list[int]
    attempts: list[int]
    failures: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    num_modes: int = 0

    @property
    def failed_attempts(self) -> int:
        """Number of attempts that were discarded."""
        return sum(self.failures.values())

    def __str__(self) -> str:
        discarded = ", ".join(f"{count} {reason}" for reason, count in self.failures.items() if count) or "none"
        counts = [self.modes.count(mode) for mode in range(self.num_modes or max(self.modes) + 1)]
        return (
            f"{len(self.modes)} demonstrations of {self.task} in {len(set(self.modes))} modes"
            f" ({', '.join(map(str, counts))}), {min(self.rows)} to {max(self.rows)} rows, {self.seconds:.1f} s;"
            f" {self.attempts.count(1)} good at the first attempt; discarded attempts: {discarded}"
        )


def record_demonstrations(
    task: str = "avoiding",
    episodes: int = 96,
    seed: int = 0,
    num_threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    dtype: torch.dtype = torch.float32,
    batch_size: int = BATCH_SIZE,
) -> tuple[TensorDict, RecordingReport]:
    """Records demonstrations of a scripted expert as flat TED data, every action labelled.

    The modes of the task are balanced: with 24 modes, 96 episodes are four of each; a remainder goes to modes that the
    seed chooses.

    Args:
        task (str): name of the task.
        episodes (int): number of demonstrations.
        seed (int): seed of modes and players. Same seed, same demonstrations, whatever the number of threads.
        num_threads (int): threads that advance the physics.
        progress (callable, optional): called with the number of demonstrations recorded and wanted.
        dtype (torch.dtype): floating type of the entries; everything is computed in float64.
        batch_size (int): episodes played at once. The demonstrations do not depend on it.

    Returns:
        tuple: flat data ``[N]`` in the storage layout of :mod:`torchrl_koap.keys`, and the :class:`RecordingReport`.

    Raises:
        ValueError: if the task is unknown or has no expert, or a number is out of range.
        RecordingError: if an episode fails again and again.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import record_demonstrations
        >>> data, report = record_demonstrations("avoiding", episodes=3, seed=1)
        >>> data["action"].shape[1], data["has_action"].all().item(), len(report.modes)
        (2, True, 3)
    """
    raw, report = record_episodes(task, episodes, seed, num_threads, progress, batch_size=batch_size)
    return episodes_to_ted(raw, task, dtype=dtype), report


def record_episodes(
    task: str = "avoiding",
    episodes: int = 96,
    seed: int = 0,
    num_threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    batch_size: int = BATCH_SIZE,
) -> tuple[list[Episode], RecordingReport]:
    """Records demonstrations with everything D3IL's recorder logs.

    Args:
        task (str): name of the task.
        episodes (int): number of demonstrations.
        seed (int): seed of modes and players. Same seed, same demonstrations, whatever the number of threads.
        num_threads (int): threads that advance the physics.
        progress (callable, optional): called with the number of demonstrations recorded and wanted.

    Keyword Args:
        batch_size (int): episodes played at once: what memory holds. The demonstrations do not depend on it.

    Returns:
        tuple: the episodes, for :func:`episodes_to_ted` and, of a task of D3IL, :func:`write_raw_episodes`, and the
        report.

    Raises:
        ValueError: if the task is unknown or has no expert, or a number is out of range.
        RecordingError: if an episode fails again and again.
    """
    facts = get_task(get_task(task).source)
    expert_of(facts)
    limits = (
        ("episodes", episodes, 1),
        ("seed", seed, 0),
        ("num_threads", num_threads, 1),
        ("batch_size", batch_size, 1),
    )
    for option, value, least in limits:
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{option} must be an integer of at least {least}, got {value!r}")
    progress = progress or (lambda done, total: None)
    return _record(facts, episodes, seed, num_threads, progress, None, batch_size)


def episodes_to_ted(raw: Sequence[Episode], task: str, *, dtype: torch.dtype = torch.float32) -> TensorDict:
    """Converts recorded episodes to flat TED data, just as reading their raw files would.

    Args:
        raw (sequence of Episode): of ``T`` rows of a raw one become ``T - 1`` steps, of a plain one ``T``.
        task (str): name of the task.
        dtype (torch.dtype): floating type of the entries.
    """
    pairs = [
        (episode.observation, episode.action)
        if isinstance(episode, PlainEpisode)
        else get_converter(task).convert(episode)
        for episode in raw
    ]
    return flatten_trajectories(
        [torch.from_numpy(frames) for frames, _ in pairs], [torch.from_numpy(steps) for _, steps in pairs], dtype=dtype
    )


def write_raw_episodes(folder: str | Path, raw: Sequence[RawEpisode]) -> list[Path]:
    """Writes recorded episodes as D3IL raw pickles ``env_000_00.pkl``, ``env_001_00.pkl``, ...

    Args:
        folder (str or Path): a folder that is new or holds no pickles.
        raw (sequence of RawEpisode): the episodes.

    Returns:
        list of Path: the files, in the order of the episodes.

    Raises:
        FileExistsError: if the folder holds pickles already; none is touched.
        TypeError: if episodes were recorded without D3IL's log.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.envs.experts.demonstrations import record_episodes, write_raw_episodes
        >>> raw, report = record_episodes("avoiding", episodes=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [file.name for file in write_raw_episodes(folder, raw)]
        ['env_000_00.pkl']
    """
    if any(isinstance(episode, PlainEpisode) for episode in raw):
        raise TypeError("episodes recorded without D3IL's log cannot be written as its pickles; save them as TED data")
    folder = Path(folder)
    if folder.is_dir() and any(folder.glob("*.pkl")):
        raise FileExistsError(f"{folder} holds pickles already; they are left as they are")
    digits = max(3, len(str(len(raw) - 1)))
    files = [folder / f"env_{index:0{digits}d}_00.pkl" for index in range(len(raw))]
    for file, episode in zip(files, raw, strict=True):
        write_raw_episode(file, episode)
    return files


def balanced_modes(episodes: int, num_modes: int, seed: int) -> list[int]:
    """Modes of a recording: each as often as any other, a remainder drawn without repetition.

    Args:
        episodes (int): number of demonstrations.
        num_modes (int): modes of the task.
        seed (int): seed of the remainder.

    Returns:
        list of int: mode of every demonstration.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import balanced_modes
        >>> balanced_modes(6, 3, seed=0)
        [0, 1, 2, 0, 1, 2]
    """
    full, rest = divmod(episodes, num_modes)
    extra = np.random.default_rng(seed).permutation(num_modes)[:rest]
    return [*range(num_modes)] * full + sorted(extra.tolist())


def _record(
    task: Task,
    episodes: int,
    seed: int,
    num_threads: int,
    progress: Callable[[int, int], None],
    rules: RecordingRules | None,
    batch_size: int = BATCH_SIZE,
) -> tuple[list[Episode], RecordingReport]:
    start = time.perf_counter()
    modes = balanced_modes(episodes, task.num_modes, seed)
    size, shown = min(batch_size, episodes), 0
    env = make_env(task, size, num_threads=num_threads, max_steps=task.max_steps, dtype=torch.float64)
    raw: list[Episode | None] = [None] * episodes
    attempts = [0] * episodes
    failures = dict.fromkeys(FAULTS, 0)
    contexts = None

    def show(over: int) -> None:  # attempts that turn out bad are played again: the bar waits for them
        nonlocal shown
        shown = max(shown, over)
        progress(shown, episodes)

    try:
        for attempt in range(MAX_ATTEMPTS):
            # drawn for all episodes, so that none depends on how many are played at once
            if attempt % _PER_CONTEXT == 0 and task.bodies:
                contexts = draw_contexts(task, episodes, np.random.default_rng((seed, attempt, _CONTEXT_STREAM)))
            left = np.array([index for index in range(episodes) if raw[index] is None])
            for begin in range(0, len(left), size):
                rows = left[begin : begin + size]
                already = sum(episode is not None for episode in raw)
                results = play(
                    env,
                    task,
                    np.arange(len(rows)),
                    [modes[row] for row in rows],
                    None if contexts is None else contexts[np.resize(rows, size)],  # the rest of the batch idles
                    [(seed, int(row), attempt) for row in rows],
                    lambda over, already=already: show(already + over),
                    rules=rules,
                )
                for row, (episode, fault) in zip(rows, results, strict=True):
                    attempts[row] += 1
                    raw[row] = episode
                    if fault:
                        failures[fault] += 1
            if all(episode is not None for episode in raw):
                break
    finally:
        env.close()
    missing = [index for index in range(episodes) if raw[index] is None]
    if missing:
        raise RecordingError(f"no good attempt out of {MAX_ATTEMPTS} for episodes {missing}: {failures}")
    rows, seconds = [len(episode) for episode in raw], time.perf_counter() - start
    return raw, RecordingReport(task.name, seed, modes, rows, attempts, failures, seconds, task.num_modes)
