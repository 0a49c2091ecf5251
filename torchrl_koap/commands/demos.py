# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap demos``: record scripted demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from torchrl_koap.commands.command import Command
from torchrl_koap.envs.experts.demonstration_folder import record_to_folder
from torchrl_koap.envs.experts.demonstrations import BATCH_SIZE
from torchrl_koap.envs.experts.recording import expert_of
from torchrl_koap.envs.experts.recording_report import RecordingReport
from torchrl_koap.envs.scooping.recording import VideoReport, record_videos
from torchrl_koap.lookup import lookup
from torchrl_koap.runs.plugins import Plugins, load_plugins
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.tasks import Task, get_task


@dataclass(kw_only=True)
class Demos(Command):
    """Record scripted demonstrations, as memory-mapped TED and as D3IL raw pickles.

    Every demonstration is written as it comes (OUT/unfinished); the same command goes on with an interrupted recording.

    Attributes:
        out: folder to write: OUT/ted and OUT/raw. Must not hold demonstrations yet.
        task: name of the task.
        episodes: number of demonstrations, spread evenly over the modes (default: that of the task).
        seed: seed of the players' variation.
        threads: simulator threads.
        batch_size: episodes played at once; the demonstrations do not depend on it.
        disturbance: share of the demonstrations in which the operator is disturbed now and then (pushes, slips, late
            turns, a height that drifts); those from which it recovers are kept, and OUT/ted/about.json says how often
            it did (default: that of the task).
        embodiment: of a task that is recorded by a camera, "robot" (with actions) or "hand" (frames alone); OUT is then
            a LeRobot data set with pictures, for `koap embed`.
        plugins: modules that register tasks; imported before anything else.
    """

    out: Path
    task: str = "avoiding"
    episodes: int | None = None
    seed: int = 0
    threads: int = 2
    batch_size: int = BATCH_SIZE
    disturbance: float | None = None
    embodiment: str | None = None
    plugins: Plugins = ()

    def __call__(self) -> RecordingReport | VideoReport:
        """Records and writes; returns the account of attempts.

        Raises:
            FileExistsError: if the folder holds demonstrations already, or an unfinished recording of other ones.
            ValueError: if the task has no environment or no scripted expert.
            RecordingError: if the operator fails again and again.
        """
        load_plugins(self.plugins)
        task = get_task(self.task)
        if task.env is None or task.expert is None:
            lacks = "environment" if task.env is None else "scripted expert"
            raise ValueError(f"task {task.name!r} has no {lacks}: there is nothing to record demonstrations with")
        episodes = task.defaults.demonstrations if self.episodes is None else self.episodes
        embodiments = getattr(expert_of(task), "embodiments", ())
        if self.embodiment is not None and not embodiments:
            raise ValueError(f"--embodiment was given, but task {task.name!r} has one embodiment alone")
        if embodiments:
            return self._film(task, episodes, embodiments)
        with progress_bar(episodes, "recording", unit="episode", delay=0.5) as bar:  # refusals come without a bar
            return record_to_folder(
                self.out,
                task,
                episodes,
                self.seed,
                self.threads,
                count_up_to(bar),
                batch_size=self.batch_size,
                disturbance=self.disturbance,
            )

    def _film(self, task: Task, episodes: int, embodiments: Sequence[str]) -> VideoReport:
        """Records camera frames."""
        if self.embodiment is None:
            raise ValueError(f"say who demonstrates: --embodiment {' or '.join(embodiments)}")
        lookup(embodiments, self.embodiment, "embodiment")
        if self.disturbance:
            raise ValueError("--disturbance was given, but demonstrations before a camera are not disturbed")
        with progress_bar(episodes, "recording", unit="episode", delay=0.5) as bar:
            return record_videos(self.out, self.embodiment, episodes, self.seed, count_up_to(bar), task=task)
