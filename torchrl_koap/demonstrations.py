# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording demonstrations: scripted experts play the library's own environments, all episodes in one batch.

An attempt that touches a cylinder, takes another mode than asked for, does not finish, or is unlike any human one (all
but touches, takes too long) is played again with other random draws; nothing else is selected, and every discarded
attempt is counted in the report.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap import keys
from torchrl_koap.data import CONVERTERS, RawEpisode, flatten_trajectories, write_raw_episode
from torchrl_koap.envs import AvoidingEnv, mode_index
from torchrl_koap.envs.avoiding import OBSTACLES
from torchrl_koap.envs.avoiding_expert import ROD_RADIUS, AvoidingExpert
from torchrl_koap.tasks import get_task

MAX_ATTEMPTS = 20
# the human demonstrations have at most 104 rows and pass the cylinders at 3 mm or more
MOST_ROWS = 120
LEAST_CLEARANCE = 0.003
_RECORDERS = {}


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
        seconds (float): wall-clock time.
    """

    task: str
    seed: int
    modes: list[int]
    rows: list[int]
    attempts: list[int]
    failures: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def failed_attempts(self) -> int:
        """Number of attempts that were discarded."""
        return sum(self.failures.values())

    def __str__(self) -> str:
        discarded = ", ".join(f"{count} {reason}" for reason, count in self.failures.items() if count) or "none"
        return (
            f"{len(self.modes)} demonstrations of {self.task} in {len(set(self.modes))} modes, {min(self.rows)} to"
            f" {max(self.rows)} rows, {self.seconds:.1f} s; discarded attempts: {discarded}"
        )


def record_demonstrations(
    task: str = "avoiding",
    episodes: int = 96,
    seed: int = 0,
    num_threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    dtype: torch.dtype = torch.float32,
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

    Returns:
        tuple: flat data ``[N]`` in the storage layout of :mod:`torchrl_koap.keys`, and the :class:`RecordingReport`.

    Raises:
        ValueError: if the task is unknown or has no expert, or a number is out of range.
        RecordingError: if an episode fails again and again.

    Examples:
        >>> from torchrl_koap.demonstrations import record_demonstrations
        >>> data, report = record_demonstrations("avoiding", episodes=3, seed=1)
        >>> data["action"].shape[1], data["has_action"].all().item(), len(report.modes)
        (2, True, 3)
    """
    raw, report = record_episodes(task, episodes, seed, num_threads, progress)
    return episodes_to_ted(raw, task, dtype=dtype), report


def record_episodes(
    task: str = "avoiding",
    episodes: int = 96,
    seed: int = 0,
    num_threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[list[RawEpisode], RecordingReport]:
    """Records demonstrations with everything D3IL's recorder logs; arguments as in :func:`record_demonstrations`.

    Returns:
        tuple: the episodes, for :func:`episodes_to_ted` and :func:`write_raw_episodes`, and the report.
    """
    get_task(task)
    if task not in _RECORDERS:
        raise ValueError(f"there is no scripted expert of task {task!r} yet; known: {', '.join(_RECORDERS)}")
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0), ("num_threads", num_threads, 1)):
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{name} must be an integer of at least {least}, got {value!r}")
    return _RECORDERS[task](episodes, seed, num_threads, progress or (lambda done, total: None))


def episodes_to_ted(raw: Sequence[RawEpisode], task: str, *, dtype: torch.dtype = torch.float32) -> TensorDict:
    """Converts recorded episodes to flat TED data, just as reading their raw files would.

    Args:
        raw (sequence of RawEpisode): ``T`` rows each, which make ``T - 1`` steps.
        task (str): name of the task.
        dtype (torch.dtype): floating type of the entries.
    """
    pairs = [CONVERTERS[task].convert(episode) for episode in raw]
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

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.demonstrations import record_episodes, write_raw_episodes
        >>> raw, report = record_episodes("avoiding", episodes=1)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [file.name for file in write_raw_episodes(folder, raw)]
        ['env_000_00.pkl']
    """
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

    Examples:
        >>> from torchrl_koap.demonstrations import balanced_modes
        >>> balanced_modes(6, 3, seed=0)
        [0, 1, 2, 0, 1, 2]
    """
    full, rest = divmod(episodes, num_modes)
    extra = np.random.default_rng(seed).permutation(num_modes)[:rest]
    return [*range(num_modes)] * full + sorted(extra.tolist())


def _record_avoiding(episodes, seed, num_threads, progress) -> tuple[list[RawEpisode], RecordingReport]:
    start = time.perf_counter()
    modes = balanced_modes(episodes, get_task("avoiding").num_modes, seed)
    env = AvoidingEnv(episodes, num_threads=num_threads, dtype=torch.float64)
    raw: list[RawEpisode | None] = [None] * episodes
    attempts = [0] * episodes
    failures = dict.fromkeys(("collision", "mode", "unfinished", "close", "slow"), 0)
    try:
        for attempt in range(MAX_ATTEMPTS):
            rows = np.array([index for index in range(episodes) if raw[index] is None])
            expert = AvoidingExpert([modes[row] for row in rows], [(seed, int(row), attempt) for row in rows])
            already = episodes - len(rows)
            results = _play(
                env, expert, rows, np.array(modes), lambda n, already=already: progress(already + n, episodes)
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
    rows = [len(episode) for episode in raw]
    return raw, RecordingReport("avoiding", seed, modes, rows, attempts, failures, time.perf_counter() - start)


def _play(env: AvoidingEnv, expert: AvoidingExpert, rows, modes, progress) -> list[tuple[RawEpisode | None, str]]:
    """One attempt of the episodes ``rows``: for each its recording, or None and what went wrong."""
    flags = np.zeros((env.batch_size[0], 1), dtype=bool)
    flags[rows] = True
    data = env.reset()
    logs, touched = [], np.zeros(len(flags), dtype=bool)
    active = flags[:, 0].copy()
    lengths = np.zeros(len(flags), dtype=np.int64)
    for _ in range(env.max_steps):
        action = np.zeros((len(flags), 2))
        action[rows] = expert.act(data[keys.OBSERVATION].numpy()[rows])
        data.set(keys.ACTION, torch.from_numpy(action)).set("_step", torch.from_numpy(active[:, None].copy()))
        data = env.step(data)["next"].clone()
        logs.append(env.raw_log())
        lengths += active
        touched |= active & env.obstacle_contacts().any(1)
        active[rows] &= ~expert.finished
        active &= ~touched
        progress(int(len(rows) - active[rows].sum() - touched.sum()))
        if not active.any():
            break
    mode = mode_index(data[keys.MODE]).numpy()
    success = data[keys.SUCCESS].squeeze(-1).numpy()
    results = []
    for row in rows:
        episode = _episode(logs[: lengths[row]], row)
        faults = {
            "collision": touched[row],
            "unfinished": active[row] or not success[row],
            "mode": mode[row] != modes[row],
            "close": _clearance(episode) < LEAST_CLEARANCE,
            "slow": len(episode) > MOST_ROWS,
        }
        fault = next((name for name, found in faults.items() if found), "")
        results.append((None if fault else episode, fault))
    return results


def _clearance(episode: RawEpisode) -> float:
    """Least distance between the rod, taken as upright, and any cylinder (m)."""
    path = episode.robot["c_pos"][:, :2]
    gaps = [np.linalg.norm(path - (x, y), axis=1).min() - radius for _, x, y, radius, _ in OBSTACLES]
    return min(gaps) - ROD_RADIUS


def _episode(logs: list[dict[str, np.ndarray]], row: int) -> RawEpisode:
    robot = {name: np.stack([log[name][row] for log in logs]) for name in logs[0]}
    robot["wall_clock"] = np.rint(robot["time_stamp"] * 1e9).astype(np.int64)  # simulated, so that files are repeatable
    return RawEpisode(robot=robot)


_RECORDERS["avoiding"] = _record_avoiding
