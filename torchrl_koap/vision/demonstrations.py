# This source code is licensed under the MIT license found in the LICENSE file.
"""Camera demonstrations as a data set of embeddings that ``koap train --dataset`` takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from torchrl_koap.data import flatten_trajectories, save_ted
from torchrl_koap.data.formats.lerobot_frames import ImageEpisode, read_image_episodes
from torchrl_koap.files import DataError
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.vision.encoder import FrozenImageEncoder
from torchrl_koap.vision.projection import Projection


@dataclass(frozen=True)
class Source:
    """Demonstrations of one embodiment.

    Args:
        folder (str or Path): a data set of ``koap demos --embodiment``.
        episodes (int, optional): how many, from the first. Default: all.
        embodiment (str, optional): refuse those of another one.
    """

    folder: str | Path
    episodes: int | None = None
    embodiment: str | None = None

    def read(self) -> list[ImageEpisode]:
        """The episodes."""
        return read_image_episodes(self.folder, episodes=self.episodes, embodiment=self.embodiment)


def fit_projection(
    encoder: FrozenImageEncoder, sources: Sequence[Source], dim: int, *, most: int = 3000, seed: int = 0
) -> Projection:
    """Fits principal components of the pooled features of unlabelled frames.

    Args:
        encoder (FrozenImageEncoder): its pooled features are taken; a projection that it has is not used.
        sources (sequence of Source): the frames.
        dim (int): number of components.
        most (int): frames that are used, drawn by the seed, the same number of every source.
        seed (int): of that choice.
    """
    chosen, generator = [], torch.Generator().manual_seed(seed)
    for source in sources:
        features = torch.cat([encoder.features(torch.from_numpy(episode.frames)) for episode in source.read()])
        chosen.append(features[torch.randperm(len(features), generator=generator)[: most // len(sources)]])
    return Projection.fit(torch.cat(chosen), dim)


def embed_demonstrations(
    out: str | Path,
    sources: Sequence[Source],
    encoder: FrozenImageEncoder,
    *,
    mixed: bool = False,
    task: Task | str = "scooping",
) -> Path:
    """Writes demonstrations as embeddings; an embodiment without actions has no labels.

    Args:
        out (str or Path): folder to write, for ``koap train --dataset``; it is returned.
        sources (sequence of Source): the demonstrations, in the order in which the data set has them.
        encoder (FrozenImageEncoder): what embeds the frames.
        mixed (bool): the data set may hold several embodiments; its notes name that of every episode.
        task (Task or str): the task, whose observation is the embedding and what the recordings hold besides.

    Raises:
        DataError: if embodiments are mixed without saying so, or a data set is unfinished.
        ValueError: if the embedding has another size than the task's, or frames another size than the encoder's.
    """
    task = get_task(task) if isinstance(task, str) else task
    episodes = [episode for source in sources for episode in source.read()]
    embodiments = [episode.embodiment for episode in episodes]
    names = sorted(set(embodiments))
    if len(names) > 1 and not mixed:
        raise DataError(
            out,
            f"the sources mix the embodiments {' and '.join(names)}: pass mixed=True (koap embed --mixed) if that is"
            " meant",
        )
    states = []
    for episode in episodes:
        embedding = encoder.embed(torch.from_numpy(episode.frames)).float()
        if embedding.shape[1] + episode.state.shape[1] != task.observation_dim:
            raise ValueError(
                f"task {task.name!r} observes {task.observation_dim} columns, embedding and recording have"
                f" {embedding.shape[1]} and {episode.state.shape[1]}"
            )
        states.append(np.concatenate([embedding.numpy(), episode.state], axis=1))
    data = flatten_trajectories(states, [episode.action for episode in episodes], action_dim=task.action_dim)
    notes = {"embodiments": embodiments, "encoder": encoder.identity}
    return save_ted(data, Path(out) / "ted", task, notes).parent
