# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap embed``: camera demonstrations as a data set of embeddings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.commands.options import Command
from torchrl_koap.data import read_about
from torchrl_koap.files import check_file
from torchrl_koap.tasks import get_task
from torchrl_koap.vision.backbones import WeightsError
from torchrl_koap.vision.demonstrations import Source, embed_demonstrations
from torchrl_koap.vision.projection import load_encoder, projection_of


@dataclass(kw_only=True)
class Embed(Command):
    """Embed camera frames with a frozen network.

    Frames are those of `koap demos --embodiment`. Nothing is downloaded.

    Example: `koap embed videos --out embedded`

    Attributes:
        sources: folders of demonstrations, in the order in which the data set has them.
        out: folder to write: OUT/ted.
        task: the task that was recorded.
        episodes: how many of each source, from the first (default: all).
        mixed: the sources may be of several embodiments.
        network: file of EfficientNet-Lite0's weights, or "module:function" of a network of your own (default: the
            weights of the extra "vision").
        projection: file of the principal components (default: those of the task that come with the package).
    """

    sources: tyro.conf.Positional[tuple[Path, ...]]
    out: Path
    task: str = "scooping"
    episodes: tuple[int, ...] = ()
    mixed: bool = False
    network: str | None = None
    projection: Path | None = None

    def __call__(self) -> dict[str, Any]:
        """Reads, embeds and writes.

        Raises:
            WeightsError: if weights are missing or of another network.
            DataError: if a source is none, embodiments are mixed without saying so.
            ValueError: if the projection is damaged.
        """
        if self.episodes and len(self.episodes) != len(self.sources):
            raise ValueError(f"--episodes names {len(self.episodes)} numbers for {len(self.sources)} sources")
        task = get_task(self.task)
        if (self.out / "ted").exists():
            raise FileExistsError(f"{self.out / 'ted'} exists already; choose another --out")
        projection = projection_of(task.name) if self.projection is None else self.projection
        try:
            if projection.exists() and not projection.is_dir():
                check_file(projection)
            encoder = load_encoder(projection, self.network)
        except (WeightsError, FileNotFoundError):  # they name the file themselves
            raise
        except Exception as error:
            fault = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"the projection {projection} cannot be used: {fault}") from error
        numbers = self.episodes or (None,) * len(self.sources)
        sources = [Source(folder, number) for folder, number in zip(self.sources, numbers, strict=True)]
        folder = embed_demonstrations(self.out, sources, encoder, mixed=self.mixed, task=task)
        about = read_about(folder / "ted")
        embodiments = about["notes"]["embodiments"]
        return {
            "data set": str(folder),
            "trajectories": ", ".join(f"{embodiments.count(name)} {name}" for name in sorted(set(embodiments))),
            "steps": about["steps"],
            "labelled steps": about["labelled_steps"],
            "next": f"koap train --task {task.name} --dataset {folder} --out runs/{task.name}",
        }
