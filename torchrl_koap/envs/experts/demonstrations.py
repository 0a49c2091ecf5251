# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording demonstrations: scripted experts play the library's own environments, in batches of bounded size.

An attempt that touches what it must not, takes another mode than asked for, does not finish, or is unlike any human one
(all but touches, takes too long) is played again with other random draws, after four attempts from another context;
nothing else is selected, and every discarded attempt is counted in the report.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.experts.disturbances import (
    Disturbances,
    choose_disturbed,
    count_spells,
    disturbed_columns,
    share_disturbed,
)
from torchrl_koap.envs.experts.recording import FAULTS, Attempt, expert_of, play
from torchrl_koap.envs.registry import make_env
from torchrl_koap.tasks import Task, get_task

MAX_ATTEMPTS = 20
BATCH_SIZE = 50  # episodes that are played at once: few enough that the first are over within seconds
_PER_CONTEXT = 4  # attempts before an episode gets another context
_CONTEXT_STREAM = 1  # keeps the draws of contexts apart from those of the players


class RecordingError(RuntimeError):
    """An episode whose expert failed in every attempt."""


@dataclass(frozen=True)
class Take:
    """One demonstration and what it took."""

    index: int  # number of the demonstration
    frames: np.ndarray  # [T, obs]
    actions: np.ndarray  # [T - 1, act]
    mode: int
    rows: int  # control steps
    attempts: int  # that it took, 1 if the first one was good
    failures: dict[str, int]  # discarded attempts by reason
    disturbed: bool = False  # whether the operator was
    # disturbances of the attempt that was kept: first control step, the one after the last, kind
    spells: tuple[tuple[int, int, str], ...] = ()

    @property
    def account(self) -> dict[str, Any]:
        """All but frames and actions."""
        return {name: value for name, value in vars(self).items() if name not in ("frames", "actions")}


@dataclass(frozen=True)
class RecordingReport:
    """What was recorded, and what it took.

    Args:
        task (Task): the task.
        seed (int): seed of the recording.
        takes (sequence of dict): :attr:`Take.account` of each demonstration, in their order.
        seconds (float): wall-clock time.
        disturbance (float): share of the demonstrations that was to be disturbed.
    """

    task: Task
    seed: int
    takes: Sequence[Mapping[str, Any]]
    seconds: float = 0.0
    disturbance: float = 0.0

    @property
    def modes(self) -> list[int]:
        """Mode of each demonstration."""
        return [take["mode"] for take in self.takes]

    @property
    def rows(self) -> list[int]:
        """Control steps of each demonstration."""
        return [take["rows"] for take in self.takes]

    @property
    def attempts(self) -> list[int]:
        """Attempts that each demonstration took."""
        return [take["attempts"] for take in self.takes]

    @property
    def failures(self) -> dict[str, int]:
        """Number of discarded attempts by reason."""
        return {name: sum(take["failures"].get(name, 0) for take in self.takes) for name in FAULTS}

    @property
    def notes(self) -> dict[str, Any]:
        """What ``about.json`` says of the recording. Disturbances are told only where there are any."""
        notes = {"seed": self.seed, "modes": self.modes, "attempts": self.attempts}
        notes["discarded_attempts"] = self.failures
        if not self.disturbance:
            return notes
        chosen = [take["attempts"] for take in self.takes if take["disturbed"]]
        return notes | {
            "disturbance": {
                "share": self.disturbance,
                "disturbed_demonstrations": len(chosen),
                "attempts_under_disturbance": sum(chosen),
                "recovered_at_the_first_attempt": chosen.count(1),
                "kept": count_spells([take["spells"] for take in self.takes]),
                "spells": [[list(spell) for spell in take["spells"]] for take in self.takes],
            }
        }

    def __str__(self) -> str:
        discarded = ", ".join(f"{count} {reason}" for reason, count in self.failures.items() if count) or "none"
        counts = [self.modes.count(mode) for mode in range(self.task.num_modes)]
        return (
            f"{len(self.modes)} demonstrations of {self.task.name} in {len(set(self.modes))} modes"
            f" ({', '.join(map(str, counts))}), {min(self.rows)} to {max(self.rows)} rows, {self.seconds:.1f} s;"
            f" {self.attempts.count(1)} good at the first attempt; discarded attempts: {discarded}{self._disturbances}"
        )

    @property
    def _disturbances(self) -> str:
        if not self.disturbance:
            return ""
        told = self.notes["disturbance"]
        kept = ", ".join(f"{count} {kind}" for kind, count in told["kept"].items())
        return (
            f"; {told['disturbed_demonstrations']} disturbed ({kept}), of which the operator recovered in"
            f" {told['disturbed_demonstrations']} of {told['attempts_under_disturbance']} attempts"
        )


def record_demonstrations(
    task: Task | str = "avoiding",
    episodes: int = 96,
    seed: int = 0,
    *,
    dtype: torch.dtype = torch.float32,
    disturbance: float | None = None,
    **options: Any,
) -> tuple[TensorDict, RecordingReport]:
    """Records demonstrations of a scripted expert as flat TED data, every action labelled.

    Args:
        task (Task or str): and all arguments but ``dtype``, see :func:`iterate_takes`.
        dtype (torch.dtype): floating type of the entries; everything is computed in float64.

    Returns:
        tuple: flat data ``[N]`` in the storage layout of :mod:`torchrl_koap.keys`, and the :class:`RecordingReport`.

    Raises:
        ValueError: as there, like ``RecordingError``.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import record_demonstrations
        >>> data, report = record_demonstrations("avoiding", episodes=3, seed=1)
        >>> data["action"].shape[1], data["has_action"].all().item(), len(report.modes)
        (2, True, 3)
    """
    task, start = get_task(task), time.perf_counter()
    takes = list(iterate_takes(task, episodes, seed, disturbance=disturbance, **options))
    seconds, share = time.perf_counter() - start, share_disturbed(task, disturbance)
    report = RecordingReport(get_task(task.source), seed, [take.account for take in takes], seconds, share)
    frames = [torch.from_numpy(take.frames) for take in takes]
    return flatten_trajectories(frames, [torch.from_numpy(take.actions) for take in takes], dtype=dtype), report


def iterate_takes(
    task: Task | str,
    episodes: int,
    seed: int = 0,
    num_threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    batch_size: int = BATCH_SIZE,
    disturbance: float | None = None,
    done: Collection[int] = (),
) -> Iterator[Take]:
    """Plays demonstrations one after the other, in their order; memory holds no more than a batch of them.

    The modes of the task are balanced: with 24 modes, 96 episodes are four of each; a remainder goes to modes that the
    seed chooses.

    Args:
        task (Task or str): the task.
        episodes (int): number of demonstrations.
        seed (int): seed of modes and players. Same seed, same demonstrations, whatever the number of threads.
        num_threads (int): threads that advance the physics.
        progress (callable, optional): called with the number of demonstrations recorded and wanted.
        batch_size (int): episodes played at once. The demonstrations do not depend on it.
        disturbance (float, optional): share of the demonstrations in which the operator is disturbed. Default: that of
            the task.
        done (collection of int): numbers of demonstrations that are there already and left out.

    Yields:
        Take: the next demonstration.

    Raises:
        ValueError: if the task is unknown or has no expert, or a number is out of range.
        RecordingError: if an episode fails again and again; it names the expert and the last failure.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import iterate_takes
        >>> [take.index for take in iterate_takes("avoiding", 4, done=[0, 2])]
        [1, 3]
    """
    task = get_task(task)
    disturbance = share_disturbed(task, disturbance)
    task = get_task(task.source)
    expert_of(task)
    numbers = {"episodes": episodes, "seed": seed, "num_threads": num_threads, "batch_size": batch_size}
    for option, value in numbers.items():
        least = 0 if option == "seed" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{option} must be an integer of at least {least}, got {value!r}")
    disturbed = choose_disturbed(episodes, disturbance, seed)
    if disturbance:
        disturbed_columns(task)
    return _play_batches(task, episodes, seed, num_threads, progress, batch_size, disturbed, frozenset(done))


def balanced_modes(episodes: int, num_modes: int, seed: int) -> list[int]:
    """Returns the mode of every demonstration: each as often as any other, a remainder drawn without repetition."""
    full, rest = divmod(episodes, num_modes)
    extra = np.random.default_rng(seed).permutation(num_modes)[:rest]
    return [*range(num_modes)] * full + sorted(extra.tolist())


def _play_batches(
    task: Task,
    episodes: int,
    seed: int,
    num_threads: int,
    progress: Callable[[int, int], None] | None,
    batch_size: int,
    disturbed: np.ndarray,
    done: frozenset[int],
) -> Iterator[Take]:
    modes, left = balanced_modes(episodes, task.num_modes, seed), [i for i in range(episodes) if i not in done]
    if not left:
        return
    size, shown = min(batch_size, len(left)), 0
    env = make_env(task, size, num_threads=num_threads, max_steps=task.max_steps, dtype=torch.float64)

    def show(found: int, over: int) -> None:  # attempts that turn out bad are played again: the bar waits for them
        nonlocal shown
        shown = max(shown, found + over)
        if progress is not None:
            progress(shown, episodes)

    @functools.cache
    def contexts_of(attempt: int) -> np.ndarray | None:
        """Drawn for all episodes, so that none depends on how many are played at once."""
        if not task.bodies:
            return None
        return draw_contexts(task, episodes, np.random.default_rng((seed, attempt, _CONTEXT_STREAM)))

    try:
        for begin in range(0, len(left), size):
            batch = np.array(left[begin : begin + size])
            already = len(done) + begin
            takes: dict[int, Take] = {}
            failures = {row: dict.fromkeys(FAULTS, 0) for row in batch}
            for attempt in range(MAX_ATTEMPTS):
                rows, kept = np.array([row for row in batch if row not in takes]), already + len(takes)
                contexts = contexts_of(attempt - attempt % _PER_CONTEXT)
                seeds = [(seed, int(row), attempt) for row in rows]
                hand = Disturbances(task, seeds, disturbed[rows]) if disturbed[rows].any() else None
                results = play(
                    env,
                    task,
                    [modes[row] for row in rows],
                    None if contexts is None else contexts[np.resize(rows, size)],  # the rest of the batch idles
                    seeds,
                    functools.partial(show, kept),
                    disturbances=hand,
                )
                for index, (row, found) in enumerate(zip(rows, results, strict=True)):
                    if found.fault:
                        failures[row][found.fault] += 1
                        last = int(row), found.fault
                        continue
                    takes[row] = Take(
                        int(row),
                        found.frames,
                        found.actions,
                        modes[row],
                        found.steps,
                        attempt + 1,
                        {name: count for name, count in failures[row].items() if count},
                        bool(disturbed[row]),
                        () if hand is None else _within(hand.spells[index], found),
                    )
                if len(takes) == len(batch):
                    break
            else:
                missing = [int(row) for row in batch if row not in takes]
                counts = {name: sum(failures[row][name] for row in batch) for name in FAULTS}
                raise RecordingError(
                    f"{task.expert} never succeeded: no good attempt out of {MAX_ATTEMPTS} for episodes {missing} of"
                    f" task {task.name!r}, seed {seed}: {counts}; the last one, episode {last[0]} in mode"
                    f" {modes[last[0]]}, ended as {last[1]!r}: {FAULTS[last[1]]}"
                )
            for row in batch:
                yield takes.pop(row)
    finally:
        env.close()


def _within(spells: Sequence[tuple[int, int, str]], found: Attempt) -> tuple[tuple[int, int, str], ...]:
    """Disturbances in steps of the data: in D3IL's log the first row is the state after the first control step."""
    last = len(found.actions)
    shift = found.steps - last
    moved = [(max(begin - shift, 0), min(end - shift, last), kind) for begin, end, kind in spells]
    return tuple(spell for spell in moved if spell[0] < spell[1])
