# This source code is licensed under the MIT license found in the LICENSE file.
"""Recording into a folder: every demonstration is written as it comes, and an interrupted recording goes on.

::

    folder/
      ted/          all demonstrations as one data set (see torchrl_koap.data.ted)
      unfinished/   while recording: what was asked for, and a file for every demonstration so far
"""

from __future__ import annotations

import functools
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_koap.data import flatten_trajectories, save_ted
from torchrl_koap.envs.experts.demonstrations import RecordingReport, Take, iterate_takes
from torchrl_koap.envs.experts.disturbances import share_disturbed
from torchrl_koap.files import one_at_a_time, replacing_file
from torchrl_koap.tasks import Task, get_task

_REQUEST = "request.json"


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
    """Records demonstrations into a folder; called again with the same arguments, it goes on where it was interrupted.

    Arguments are those of :func:`~torchrl_koap.envs.experts.demonstrations.iterate_takes`. A folder that holds
    demonstrations already, or other unfinished ones, or that another process records into, is refused.
    """
    start, disturbance = time.perf_counter(), share_disturbed(task, disturbance)
    task = get_task(task.source)
    request = {"task": task.name, "episodes": episodes, "seed": seed, "disturbance": disturbance}
    iterating = functools.partial(iterate_takes, task, episodes, seed, disturbance=disturbance, **options)
    iterating()  # looks at the arguments before anything is written
    files = _Files(Path(folder), episodes)
    files.refuse_others(request)
    with one_at_a_time(files.unfinished / ".lock", busy=f"another process records into {folder}"):
        done = files.begin(request)
        if progress is not None:
            progress(len(done), episodes)
        for take in iterating(progress=progress, done=done):
            files.add(take)
        frames, actions, logs = files.read()
        report = RecordingReport(task, seed, logs, time.perf_counter() - start, disturbance)
        save_ted(flatten_trajectories(frames, actions), files.ted, task, report.notes)
    shutil.rmtree(files.unfinished)
    return report


class _Files:
    """Files of one recording."""

    def __init__(self, folder: Path, episodes: int):
        self.ted, self.unfinished, self._episodes = folder / "ted", folder / "unfinished", episodes

    def refuse_others(self, request: dict) -> None:
        begun = self.unfinished / _REQUEST
        if self.ted.exists():
            raise FileExistsError(f"{self.ted} exists already; choose another --out")
        there = json.loads(begun.read_text()) if begun.exists() else request
        asked = request.items()
        other = [f"{key} {there.get(key)!r}, not {value!r}" for key, value in asked if there.get(key) != value]
        if other:
            raise FileExistsError(
                f"{self.unfinished} holds an interrupted recording with {', '.join(other)}: ask for the same to go on,"
                " or remove it"
            )

    def begin(self, request: dict) -> set[int]:
        """Notes what is asked for; returns the numbers of the demonstrations that are there already."""
        self.unfinished.mkdir(parents=True, exist_ok=True)
        with replacing_file(self.unfinished / _REQUEST) as aside:
            aside.write_text(json.dumps(request))
        return {index for index in range(self._episodes) if self._file(index).exists()}

    def add(self, take: Take) -> None:
        with replacing_file(self._file(take.number)) as aside, open(aside, "wb") as file:
            np.savez(file, frames=take.frames, actions=take.actions, log=json.dumps(take.log))

    def read(self) -> tuple[list[torch.Tensor], list[torch.Tensor], list[dict]]:
        """Frames, actions and log of all demonstrations."""
        frames, actions, logs = [], [], []
        for index in range(self._episodes):
            with np.load(self._file(index), allow_pickle=False) as held:
                frames.append(torch.from_numpy(held["frames"]).float())
                actions.append(torch.from_numpy(held["actions"]).float())
                logs.append(json.loads(held["log"].item()))
        return frames, actions, logs

    def _file(self, index: int) -> Path:
        return self.unfinished / f"{index:0{max(3, len(str(self._episodes - 1)))}d}.npz"
