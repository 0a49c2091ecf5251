# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap demos``: record scripted demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from torchrl_koap.data import save_ted
from torchrl_koap.envs.experts.demonstrations import (
    BATCH_SIZE,
    RecordingReport,
    episodes_to_ted,
    record_episodes,
    write_raw_episodes,
)
from torchrl_koap.tasks import get_task


@dataclass
class Demos:
    """Record scripted demonstrations, as memory-mapped TED and as D3IL raw pickles.

    Attributes:
        out: folder to write: OUT/ted and OUT/raw. Must not hold demonstrations yet.
        task: name of the task.
        episodes: number of demonstrations, spread evenly over the modes (default: that of the task).
        seed: seed of the players' variation.
        threads: simulator threads.
        batch_size: episodes played at once; the demonstrations do not depend on it.
    """

    out: Path
    task: str = "avoiding"
    episodes: int | None = None
    seed: int = 0
    threads: int = 2
    batch_size: int = BATCH_SIZE


def run_demos(options: Demos) -> RecordingReport:
    """Records and writes; returns the account of attempts.

    Raises:
        FileExistsError: if the folder holds demonstrations already.
    """
    task = get_task(options.task)
    for name in ("ted", "raw"):
        if (options.out / name).exists():
            raise FileExistsError(f"{options.out / name} exists already; choose another --out")
    episodes = task.demonstrations if options.episodes is None else options.episodes
    with tqdm(total=episodes, desc="recording", unit="episode") as bar:
        raw, report = record_episodes(
            task.name,
            episodes,
            options.seed,
            options.threads,
            lambda recorded, wanted: bar.update(recorded - bar.n),
            batch_size=options.batch_size,
        )
    data = episodes_to_ted(raw, task.name)
    save_ted(data, options.out / "ted", task=task.source, notes={"seed": options.seed, "modes": list(report.modes)})
    write_raw_episodes(options.out / "raw", raw)
    return report
