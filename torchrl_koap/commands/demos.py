# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap demos``: record scripted demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl_koap.commands.command import Command
from torchrl_koap.data import save_ted
from torchrl_koap.envs.experts.demonstrations import (
    BATCH_SIZE,
    RecordingReport,
    episodes_to_ted,
    record_episodes,
    write_raw_episodes,
)
from torchrl_koap.tasks import get_task
from torchrl_koap.training.plugins import Plugins, load_plugins
from torchrl_koap.training.progress import count_up_to, progress_bar


@dataclass(kw_only=True)
class Demos(Command):
    """Record scripted demonstrations, as memory-mapped TED and as D3IL raw pickles.

    Attributes:
        out: folder to write: OUT/ted and OUT/raw. Must not hold demonstrations yet.
        task: name of the task.
        episodes: number of demonstrations, spread evenly over the modes (default: that of the task).
        seed: seed of the players' variation.
        threads: simulator threads.
        batch_size: episodes played at once; the demonstrations do not depend on it.
        plugins: modules that register tasks; imported before anything else.
    """

    out: Path
    task: str = "avoiding"
    episodes: int | None = None
    seed: int = 0
    threads: int = 2
    batch_size: int = BATCH_SIZE
    plugins: Plugins = ()

    def __call__(self) -> RecordingReport:
        """Records and writes; returns the account of attempts.

        Raises:
            FileExistsError: if the folder holds demonstrations already.
            ValueError: if the task has no environment or no scripted expert.
        """
        load_plugins(self.plugins)
        task = get_task(self.task)
        if task.env is None or task.expert is None:
            lacks = "environment" if task.env is None else "scripted expert"
            raise ValueError(f"task {task.name!r} has no {lacks}: there is nothing to record demonstrations with")
        for name in ("ted", "raw"):
            if (self.out / name).exists():
                raise FileExistsError(f"{self.out / name} exists already; choose another --out")
        episodes = task.defaults.demonstrations if self.episodes is None else self.episodes
        with progress_bar(episodes, "recording", unit="episode") as bar:
            raw, report = record_episodes(
                task.name, episodes, self.seed, self.threads, count_up_to(bar), batch_size=self.batch_size
            )
        data = episodes_to_ted(raw, task.name)
        save_ted(data, self.out / "ted", task=task.source, notes={"seed": self.seed, "modes": list(report.modes)})
        if task.converter is not None:
            write_raw_episodes(self.out / "raw", raw)
        return report
