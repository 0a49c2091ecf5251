# This source code is licensed under the MIT license found in the LICENSE file.
"""Records demonstrations of scripted experts in the library's own environments, in batches of bounded size.

An attempt is discarded if it touches a forbidden body, takes another mode than asked for, does not finish, or is unlike
any human one (passes too near, takes too long). It is repeated with other random draws, after four attempts in another
context. Nothing else is selected; the report counts every discarded attempt.

A recording into a folder saves each demonstration when it is done, and continues after an interruption::

    folder/
      ted/          all demonstrations as one data set (see torchrl_koap.data.ted)
      unfinished/   while recording: the request, and a file for every demonstration so far
"""

from __future__ import annotations

import functools
import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap.data import flatten_trajectories, save_ted
from torchrl_koap.data.sources import check_new
from torchrl_koap.envs.contexts import draw_contexts
from torchrl_koap.envs.experts.disturbances import KINDS, Disturbances, choose_disturbed, disturbed_columns
from torchrl_koap.envs.experts.recording import FAULTS, Attempt, expert_of, play
from torchrl_koap.envs.registry import make_env
from torchrl_koap.files import one_at_a_time, replacing_file
from torchrl_koap.tasks import Task, get_task

MAX_ATTEMPTS = 20
BATCH_SIZE = 50  # parallel episodes; few enough that the first end within seconds
_PER_CONTEXT = 4  # attempts before an episode gets another context
_CONTEXT_STREAM = 1  # last number in the seed of contexts, which second attempts of episodes 0, 4, ... share


class RecordingError(RuntimeError):
    """Raised if an expert fails in every attempt at an episode."""


class Take(NamedTuple):
    """One demonstration."""

    number: int
    frames: np.ndarray  # [T, obs]
    actions: np.ndarray  # [T - 1, act]
    # mode, rows (control steps), attempts, failures (discarded attempts by reason), disturbed (bool), and spells (the
    # disturbances of the attempt that was kept)
    log: dict[str, Any]


@dataclass(frozen=True)
class RecordingReport:
    """The demonstrations of a recording, the discarded attempts and the time that it took."""

    task: Task
    seed: int
    logs: Sequence[Mapping[str, Any]]  # of each demonstration, in their order
    seconds: float  # of wall-clock time
    disturbance: float  # requested share of disturbed demonstrations

    def each(self, fact: str) -> list[Any]:
        """Returns one fact of every demonstration, such as ``"mode"`` or ``"rows"``."""
        return [log[fact] for log in self.logs]

    @property
    def notes(self) -> dict[str, Any]:
        """Entries of the recording in ``about.json``; disturbances only if there are any."""
        discarded = {name: sum(counts.get(name, 0) for counts in self.each("failures")) for name in FAULTS}
        notes = {"seed": self.seed, "modes": self.each("mode"), "attempts": self.each("attempts")}
        notes["discarded_attempts"] = discarded
        return notes | ({"disturbance": self.disturbance, "spells": self.each("spells")} if self.disturbance else {})

    def __str__(self) -> str:
        notes, modes, rows = self.notes, self.each("mode"), self.each("rows")
        discarded = ", ".join(f"{count} {reason}" for reason, count in notes["discarded_attempts"].items() if count)
        counts = [str(modes.count(mode)) for mode in range(self.task.modes.number)]
        shares = f" in {len(set(modes))} modes ({', '.join(counts)})" if len(counts) > 1 else ""
        said = (
            f"{len(modes)} demonstrations of {self.task.name}{shares}, {min(rows)} to {max(rows)} rows,"
            f" {self.seconds:.1f} s; {notes['attempts'].count(1)} good at the first attempt;"
            f" discarded attempts: {discarded or 'none'}"
        )
        if self.disturbance:
            chosen = [log["attempts"] for log in self.logs if log["disturbed"]]
            kinds = Counter(kind for spells in self.each("spells") for *_, kind in spells)
            kept = ", ".join(f"{kinds[kind]} {kind}" for kind in KINDS)
            said += f"; {len(chosen)} disturbed ({kept}), from which the operator recovered in"
            said += f" {len(chosen)} of {sum(chosen)} attempts"
        return said


def record_demonstrations(
    task: Task | str = "avoiding",
    episodes: int = 96,
    seed: int = 0,
    *,
    disturbance: float | None = None,
    **options: Any,
) -> tuple[TensorDict, RecordingReport]:
    """Records demonstrations of a scripted expert as flat TED data ``[N]``, every action labelled, with a report.

    Everything is computed in float64, the entries are float32. Arguments and errors are those of :func:`iterate_takes`.
    """
    task, start = get_task(task), time.perf_counter()
    takes = list(iterate_takes(task, episodes, seed, disturbance=disturbance, **options))
    seconds, share = time.perf_counter() - start, _share(task, disturbance)
    report = RecordingReport(get_task(task.source), seed, [take.log for take in takes], seconds, share)
    frames, actions = [take.frames for take in takes], [take.actions for take in takes]
    return flatten_trajectories(frames, actions), report


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
    """Plays demonstrations and yields them in order; memory holds no more than a batch of them.

    The modes of the task are balanced: with 24 modes, 96 episodes are four of each; the seed chooses modes for a
    remainder. Demonstrations depend on the seed, not on ``num_threads`` and ``batch_size``. ``progress`` is called with
    the numbers of demonstrations recorded and wanted. Numbers in ``done`` are left out. ``disturbance`` is the share of
    demonstrations with a disturbed operator, by default the task's.

    Raises:
        ValueError: if the task is unknown or has no expert, or a number is out of range.
        RecordingError: if an episode fails in every attempt; it names the expert and the last failure.
    """
    task = get_task(task)
    disturbance = _share(task, disturbance)
    task = get_task(task.source)
    if expert_of(task).embodiments:
        raise ValueError(f"demonstrations of task {task.name!r} are videos: use record_videos, or --embodiment")
    numbers = {"episodes": episodes, "seed": seed, "num_threads": num_threads, "batch_size": batch_size}
    for option, value in numbers.items():
        least = 0 if option == "seed" else 1
        if isinstance(value, bool) or not isinstance(value, int) or value < least:
            raise ValueError(f"{option} must be an integer of at least {least}, got {value!r}")
    disturbed = choose_disturbed(episodes, disturbance, seed)
    if disturbance:
        disturbed_columns(task)
    modes = balanced_modes(episodes, task.modes.number, seed)
    return _play_batches(task, modes, seed, num_threads, progress, batch_size, disturbed, frozenset(done))


def balanced_modes(episodes: int, num_modes: int, seed: int) -> list[int]:
    """Returns the mode of every demonstration: each as often as any other, a remainder drawn without repetition."""
    full, rest = divmod(episodes, num_modes)
    extra = np.random.default_rng(seed).permutation(num_modes)[:rest]
    return [*range(num_modes)] * full + sorted(extra.tolist())


def _play_batches(
    task: Task,
    modes: Sequence[int],
    seed: int,
    num_threads: int,
    progress: Callable[[int, int], None] | None,
    batch_size: int,
    disturbed: np.ndarray,
    done: frozenset[int],
) -> Iterator[Take]:
    left = [index for index in range(len(modes)) if index not in done]
    if not left:
        return
    size, shown = min(batch_size, len(left)), 0
    env = make_env(task, size, num_threads=num_threads, dtype=torch.float64)

    def show(found: int, over: int) -> None:  # the bar waits while discarded attempts are repeated
        nonlocal shown
        shown = max(shown, found + over)
        if progress is not None:
            progress(shown, len(modes))

    @functools.cache
    def contexts_of(attempt: int) -> np.ndarray | None:
        """Draws contexts of all episodes, so that none depends on the batch size."""
        if not task.scene.varies:
            return None
        return draw_contexts(task, len(modes), np.random.default_rng((seed, attempt, _CONTEXT_STREAM)))

    try:
        for begin in range(0, len(left), size):
            batch = left[begin : begin + size]
            takes: dict[int, Take] = {}
            failures: dict[int, Counter[str]] = {row: Counter() for row in batch}
            for attempt in range(MAX_ATTEMPTS):
                rows, kept = [row for row in batch if row not in takes], len(done) + begin + len(takes)
                contexts = contexts_of(attempt - attempt % _PER_CONTEXT)
                seeds = [(seed, row, attempt) for row in rows]
                hand = Disturbances(task, seeds, disturbed[rows])
                drawn = np.random.SeedSequence(seeds[0]).generate_state(1)
                env.set_seed(int(drawn[0]))  # for the environment's own random numbers
                results = play(
                    env,
                    task,
                    [modes[row] for row in rows],
                    None if contexts is None else contexts[np.resize(rows, size)],  # the rest of the batch idles
                    seeds,
                    functools.partial(show, kept),
                    hand,
                )
                for row, found, spells in zip(rows, results, hand.spells, strict=True):
                    if found.fault:
                        failures[row][found.fault] += 1
                        last = row, found.fault
                        continue
                    log: dict[str, Any] = {"mode": modes[row], "rows": found.steps, "attempts": attempt + 1}
                    log |= {"failures": dict(failures[row]), "disturbed": bool(disturbed[row])}
                    takes[row] = Take(row, found.frames, found.actions, log | {"spells": _within(spells, found)})
                if len(takes) == len(batch):
                    break
            else:
                missing = [row for row in batch if row not in takes]
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
    """Returns disturbances in steps of the data; D3IL's log begins with the state after the first control step."""
    last = len(found.actions)
    shift = found.steps - last
    moved = [(max(begin - shift, 0), min(end - shift, last), kind) for begin, end, kind in spells]
    return tuple(spell for spell in moved if spell[0] < spell[1])


def record_to_folder(
    folder: str | Path,
    task: Task,
    episodes: int,
    seed: int = 0,
    *,
    progress: Callable[[int, int], None] | None = None,
    disturbance: float | None = None,
    **options: Any,
) -> RecordingReport:
    """Records demonstrations into a folder; a call with the same arguments continues an interrupted recording.

    Arguments are those of :func:`iterate_takes`. Raises an error if the folder holds demonstrations or an interrupted
    recording with other arguments, or if another process records into it.
    """
    start, disturbance = time.perf_counter(), _share(task, disturbance)
    task = get_task(task.source)
    request = {"task": task.name, "episodes": episodes, "seed": seed, "disturbance": disturbance}
    iterating = functools.partial(iterate_takes, task, episodes, seed, disturbance=disturbance, **options)
    iterating()  # checks the arguments before anything is written
    ted, unfinished = Path(folder) / "ted", Path(folder) / "unfinished"
    begun, files = unfinished / "request.json", [unfinished / f"{number:05d}.npz" for number in range(episodes)]
    check_new(folder)
    there = json.loads(begun.read_text()) if begun.exists() else request
    other = [f"{key} {there.get(key)!r}, not {value!r}" for key, value in request.items() if there.get(key) != value]
    if other:
        raise FileExistsError(
            f"{unfinished} holds an interrupted recording with {', '.join(other)}: continue with the same arguments, or"
            " remove it"
        )
    with one_at_a_time(unfinished / ".lock", busy=f"another process records into {folder}"):
        with replacing_file(begun) as aside:
            aside.write_text(json.dumps(request))
        done = [number for number, file in enumerate(files) if file.exists()]
        if progress is not None:
            progress(len(done), episodes)
        for take in iterating(progress=progress, done=done):
            with replacing_file(files[take.number]) as aside, open(aside, "wb") as stream:
                np.savez(stream, frames=take.frames, actions=take.actions, log=json.dumps(take.log))
        frames, actions, logs = [], [], []
        for file in files:
            with np.load(file, allow_pickle=False) as held:
                frames.append(held["frames"])
                actions.append(held["actions"])
                logs.append(json.loads(held["log"].item()))
        report = RecordingReport(task, seed, logs, time.perf_counter() - start, disturbance)
        save_ted(flatten_trajectories(frames, actions), ted, task, report.notes)
    shutil.rmtree(unfinished)
    return report


def _share(task: Task, asked: float | None) -> float:
    """Returns the share of demonstrations with a disturbed operator, by default the task's."""
    return task.defaults.disturbance if asked is None else asked
