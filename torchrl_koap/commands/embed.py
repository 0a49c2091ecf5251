# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap embed``: turns data with camera frames into a data set of embeddings."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from torchrl_koap.commands.options import Command, training_call
from torchrl_koap.data.sources import check_new
from torchrl_koap.data.ted import read_about
from torchrl_koap.runs.plugins import Plugins, load_plugins
from torchrl_koap.runs.progress import count_up_to, progress_bar
from torchrl_koap.tasks import get_task
from torchrl_koap.vision.embedding import embed_recordings, read_sources
from torchrl_koap.vision.encoder import Projection, projection_of


@dataclass(kw_only=True)
class Embed(Command):
    """Embed camera frames with a frozen network.

    The result is for `koap train`. Nothing is downloaded.

    The same command resumes an interrupted embedding.

    Example: `koap embed arm --camera top --camera wrist --out arm_seen`

    Attributes:
        sources: folders that `koap convert` wrote (with --task any recordings), in the order of the data set.
        out: folder to write: OUT/ted with the data, OUT/cameras with the principal components.
        camera: cameras to embed (default: all).
        components: principal components per camera, fitted to the frames (a task with embeddings has its own number).
        network: "package.module:name" or "file.py:name" of a network of your own (default: EfficientNet-Lite0 of the
            extra "vision").
        task: a task with embeddings among its columns, such as "scooping" (default: that of the first
            source with labels).
        projection: file of principal components to use (default: those of the task that come with the package, else
            they are fitted).
        plugins: modules that register tasks; imported before anything else.
    """

    sources: tyro.conf.Positional[tuple[Path, ...]]
    out: Path
    camera: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    components: int = 32
    network: str | None = None
    task: str | None = None
    projection: Path | None = None
    plugins: Plugins = ()

    def __call__(self) -> dict[str, Any]:
        """Reads, embeds and writes."""
        load_plugins(self.plugins)
        check_new(self.out)
        asked = None if self.task is None else get_task(self.task)
        file = self.projection
        if file is None and asked is not None:
            with contextlib.suppress(ValueError):  # most tasks have no projection: it is fitted
                file = projection_of(asked.name)
        projection = None if file is None else Projection.load(file)
        recordings, task = read_sources(self.sources, asked)
        frames = len(self.camera or recordings.cameras) * sum(map(len, recordings.states))
        with progress_bar(frames, "embedding", unit="frame", delay=1) as bar:
            reports = embed_recordings(
                recordings,
                task,
                self.out,
                cameras=self.camera,
                network=self.network,
                components=self.components,
                projection=projection,
                progress=count_up_to(bar),
            )
        about = read_about(self.out / "ted")
        return {
            "data set": str(self.out),
            **{f"camera {name}": str(report) for name, report in reports.items()},
            "trajectories": about["trajectories"],
            "steps": about["steps"],
            "labelled steps": about["labelled_steps"],
            "next": training_call(self.out, task.name),
        }
