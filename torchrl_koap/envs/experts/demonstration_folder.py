# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording into a folder: every demonstration is written as it comes, and an interrupted recording goes on.

::

    folder/
      ted/          all demonstrations as one data set (see torchrl_koap.data.ted)
      raw/          one file per demonstration in D3IL's own format, for tasks of D3IL
      unfinished/   while recording: what was asked for, an account of every demonstration so far, and its file

Memory holds one batch of episodes, and at the end the data set itself in single precision.
"""

from __future__ import annotations

import functools
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
import torch

from torchrl_koap.data import RawEpisode, flatten_trajectories, read_raw_episode, save_ted, write_raw_episode
from torchrl_koap.data.d3il.conversion import get_converter
from torchrl_koap.envs.experts.demonstrations import BATCH_SIZE, iterate_takes
from torchrl_koap.envs.experts.disturbances import share_disturbed
from torchrl_koap.envs.experts.recording import PlainEpisode
from torchrl_koap.envs.experts.recording_report import RecordingReport, Take
from torchrl_koap.files import one_at_a_time, replacing_file
from torchrl_koap.tasks import Task, get_task

_REQUEST, _ACCOUNT = "request.json", "takes.jsonl"


def record_to_folder(
    folder: str | Path,
    task: Task,
    episodes: int,
    seed: int = 0,
    num_threads: int = 2,
    progress: Callable[[int, int], None] | None = None,
    *,
    batch_size: int = BATCH_SIZE,
    disturbance: float | None = None,
) -> RecordingReport:
    """Records demonstrations into a folder; called again with the same arguments, it goes on where it was interrupted.

    Args:
        folder (str or Path): where ``ted`` and ``raw`` shall lie.
        task (Task): the task.
        episodes (int): number of demonstrations.
        seed (int): seed of modes and players.
        num_threads (int): threads that advance the physics.
        progress (callable, optional): called with the number of demonstrations recorded and wanted.

    Keyword Args:
        batch_size (int): episodes played at once. The demonstrations do not depend on it.
        disturbance (float, optional): share of the demonstrations in which the operator is disturbed. Default: that of
            the task.

    Raises:
        FileExistsError: if the folder holds demonstrations already, or an unfinished recording of other ones.
        LockedError: if another process records into the folder.
        ValueError: if the task has no expert, or a number is out of range.
        RecordingError: if an episode fails again and again.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_koap.envs.experts.demonstration_folder import record_to_folder
        >>> from torchrl_koap.tasks import get_task
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     report = record_to_folder(folder, get_task("avoiding"), 2)
        ...     sorted(path.name for path in Path(folder).iterdir()), len(report.rows)
        (['raw', 'ted'], 2)
    """
    start, disturbance = time.perf_counter(), share_disturbed(task, disturbance)
    task = get_task(task.source)
    request = {"task": task.name, "episodes": episodes, "seed": seed, "disturbance": disturbance}
    iterating = functools.partial(
        iterate_takes, task, episodes, seed, num_threads, batch_size=batch_size, disturbance=disturbance
    )
    iterating()  # looks at the arguments before anything is written
    files = _Files(Path(folder), task, episodes)
    files.refuse_others(request)
    with one_at_a_time(files.unfinished / ".lock", busy=f"another process records into {folder}"):
        done = files.begin(request)
        if progress is not None:
            progress(len(done), episodes)
        for take in iterating(progress, done=done):
            files.add(take)
        account = files.account()
        seconds = time.perf_counter() - start
        report = RecordingReport.of(task, seed, [account[index] for index in range(episodes)], seconds, disturbance)
        files.finish(report)
    shutil.rmtree(files.unfinished)
    return report


class _Files:
    """Files of one recording."""

    def __init__(self, folder: Path, task: Task, episodes: int):
        self._folder, self._task, self._episodes = folder, task, episodes
        self._raw = task.converter is not None
        self.unfinished = folder / "unfinished"

    def refuse_others(self, request: dict) -> None:
        begun = self.unfinished / _REQUEST
        for name in ("ted", "raw"):
            if (self._folder / name).exists() and not (name == "raw" and begun.exists()):
                raise FileExistsError(f"{self._folder / name} exists already; choose another --out")
        there = json.loads(begun.read_text()) if begun.exists() else request
        other = [
            f"{key} {there.get(key)!r}, not {value!r}" for key, value in request.items() if there.get(key) != value
        ]
        if other:
            raise FileExistsError(
                f"{self.unfinished} holds an interrupted recording with {', '.join(other)}: ask for the same to go on,"
                " or remove it"
            )

    def begin(self, request: dict) -> set[int]:
        """Notes what is asked for; returns the numbers of the demonstrations that are there already."""
        (self.unfinished / "raw").mkdir(parents=True, exist_ok=True)
        with replacing_file(self.unfinished / _REQUEST) as aside:
            aside.write_text(json.dumps(request))
        account = self.account()
        with replacing_file(self.unfinished / _ACCOUNT) as aside:  # without a half-written last line
            aside.write_text("".join(json.dumps(take) + "\n" for take in account.values()))
        return set(account)

    def add(self, take: Take) -> None:
        path = self._file(self.unfinished / "raw", take.index)
        if self._raw:
            write_raw_episode(path, cast("RawEpisode", take.episode))
        else:
            plain = cast("PlainEpisode", take.episode)
            with replacing_file(path) as aside, open(aside, "wb") as file:
                np.savez(file, observation=plain.observation, action=plain.action)
        line = {name: value for name, value in vars(take).items() if name != "episode"}
        with open(self.unfinished / _ACCOUNT, "a") as file:
            file.write(json.dumps(line) + "\n")

    def account(self) -> dict[int, dict]:
        """The account of every demonstration whose file is there."""
        path, account = self.unfinished / _ACCOUNT, {}
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                take = json.loads(line)
            except json.JSONDecodeError:  # the process ended while it wrote this line
                continue
            if self._find(take["index"]).exists():
                account[take["index"]] = take
        return account

    def finish(self, report: RecordingReport) -> None:
        frames, steps = zip(*(self._trajectory(index) for index in range(self._episodes)), strict=True)
        data = flatten_trajectories(frames, steps)
        del frames, steps
        if self._raw and not (self._folder / "raw").exists():
            os.replace(self.unfinished / "raw", self._folder / "raw")
        save_ted(data, self._folder / "ted", task=self._task.name, notes=report.notes)

    def _file(self, folder: Path, index: int) -> Path:
        digits = max(3, len(str(self._episodes - 1)))
        return folder / (f"env_{index:0{digits}d}_00.pkl" if self._raw else f"{index:0{digits}d}.npz")

    def _find(self, index: int) -> Path:
        """The file of a demonstration; an interruption at the very end may have left it in its last place."""
        last = self._file(self._folder / "raw", index)
        return last if last.exists() else self._file(self.unfinished / "raw", index)

    def _trajectory(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        if self._raw:
            frames, steps = get_converter(self._task.name).convert(read_raw_episode(self._find(index)))
        else:
            with np.load(self._find(index), allow_pickle=False) as held:
                frames, steps = held["observation"], held["action"]
        return torch.from_numpy(frames).float(), torch.from_numpy(steps).float()
