# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap embed``: camera demonstrations as a data set of embeddings."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.commands.command import Command
from torchrl_koap.data import read_about
from torchrl_koap.files import check_file
from torchrl_koap.tasks import get_task
from torchrl_koap.vision.backbones import WeightsError
from torchrl_koap.vision.cache import CacheError
from torchrl_koap.vision.demonstrations import Source, embed_demonstrations
from torchrl_koap.vision.projections import load_encoder, projection_of


@dataclass(kw_only=True)
class Embed(Command):
    """Embed the frames of `koap demos --embodiment` with a frozen network, for `koap train --dataset`.

    Nothing is downloaded: the weights are those of the extra "vision", or a file of your own.

    Attributes:
        sources: folders of demonstrations, in the order in which the data set has them.
        out: folder to write: OUT/ted.
        task: the task that was recorded.
        episodes: how many of each source, from the first (default: all).
        mixed: the sources may be of several embodiments.
        align_to: with --mixed, the embodiment whose frames those of all others are made to resemble, by an affine map
            that is fitted without labels (default: they are left as they are).
        weights: file of the network's weights (default: EfficientNet-Lite0, extra "vision").
        projection: file of the principal components (default: those of the task that come with the package).
        cache: folder that keeps what went through the network.
    """

    sources: tyro.conf.Positional[tuple[Path, ...]]
    out: Path
    task: str = "scooping"
    episodes: tuple[int, ...] = ()
    mixed: bool = False
    align_to: str | None = None
    weights: Path | None = None
    projection: Path | None = None
    cache: Path | None = None

    def __call__(self) -> dict[str, Any]:
        """Reads, embeds and writes.

        Raises:
            WeightsError: if weights are missing or of another network.
            ImageDataError: if a source is none, embodiments are mixed without saying so, or there is nothing to align.
            CacheError: if the cache is of other weights.
            ValueError: if projection or cache are damaged.
        """
        if self.episodes and len(self.episodes) != len(self.sources):
            raise ValueError(f"--episodes names {len(self.episodes)} numbers for {len(self.sources)} sources")
        task = get_task(self.task)
        if (self.out / "ted").exists():
            raise FileExistsError(f"{self.out / 'ted'} exists already; choose another --out")
        projection = projection_of(task.name) if self.projection is None else self.projection
        with _naming("projection", projection):
            encoder = load_encoder(projection, self.weights)
        if self.cache is not None:
            with _naming("cache", self.cache):
                encoder = load_encoder(projection, self.weights, cache=self.cache)
        numbers = self.episodes or (None,) * len(self.sources)
        sources = [Source(folder, number) for folder, number in zip(self.sources, numbers, strict=True)]
        folder = embed_demonstrations(self.out, sources, encoder, mixed=self.mixed, align_to=self.align_to, task=task)
        about = read_about(folder / "ted")
        whose = about["notes"]["embodiments"]
        return {
            "data set": str(folder),
            "trajectories": ", ".join(f"{whose.count(name)} {name}" for name in sorted(set(whose))),
            "steps": about["steps"],
            "labelled steps": about["labelled_steps"],
            **({"aligned to": self.align_to} if self.align_to else {}),
            "next": f"koap train --task {task.name} --dataset {folder} --out runs/{task.name}",
        }


@contextlib.contextmanager
def _naming(what: str, path: Path) -> Iterator[None]:
    """Whatever a damaged file leads to inside the block says which file it is."""
    try:
        if path.exists() and not path.is_dir():
            check_file(path)
        yield
    except (WeightsError, CacheError, FileNotFoundError):  # they say so themselves
        raise
    except Exception as error:
        fault = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"the {what} {path} cannot be used: {fault}") from error
