# This source code is licensed under the MIT license found in the LICENSE file.
"""Camera demonstrations as a data set of embeddings that ``koap train --dataset`` takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchrl_koap.data import flatten_trajectories, save_ted
from torchrl_koap.data.lerobot.images import ImageDataError, ImageEpisode, read_image_episodes
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.vision.alignment import fit_alignment
from torchrl_koap.vision.encoder import FrozenImageEncoder
from torchrl_koap.vision.pooling import Projection


@dataclass(frozen=True)
class Source:
    """Demonstrations of one embodiment.

    Args:
        folder (str or Path): a data set of ``koap demos --embodiment``.
        episodes (int, optional): how many, from the first. Default: all.
        embodiment (str, optional): refuse those of another one.

    Examples:
        >>> from torchrl_koap.vision.demonstrations import Source
        >>> Source("videos/robot", episodes=5).embodiment is None
        True
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
    """Principal components of the pooled features of unlabelled frames.

    Args:
        encoder (FrozenImageEncoder): its pooled features are taken; a projection that it has is not used.
        sources (sequence of Source): the frames.
        dim (int): number of components.

    Keyword Args:
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
    align_to: str | None = None,
    task: Task | str = "scooping",
) -> Path:
    """Writes demonstrations as embeddings; an embodiment without actions has no labels.

    Args:
        out (str or Path): folder to write, for ``koap train --dataset``.
        sources (sequence of Source): the demonstrations, in the order in which the data set has them.
        encoder (FrozenImageEncoder): what embeds the frames.

    Keyword Args:
        mixed (bool): the data set may hold several embodiments; its notes say which episodes are whose.
        align_to (str, optional): an embodiment that all others are moved to, each by an affine map of its embeddings
            (:func:`~torchrl_koap.vision.alignment.fit_alignment`). Default: embeddings are left as they are.
        task (Task or str): the task, whose observation is the embedding and what the recordings hold besides.

    Returns:
        Path: the folder.

    Raises:
        ImageDataError: if embodiments are mixed without saying so, none or all of the demonstrations are of the one to
            align to, or a data set is unfinished.
        ValueError: if the embedding has another size than the task's, or frames another size than the encoder's.
    """
    task = get_task(task) if isinstance(task, str) else task
    states, actions, whose = [], [], []
    read = [source.read() for source in sources]
    names = sorted({episode.embodiment for episodes in read for episode in episodes})
    if len(names) > 1 and not mixed:
        raise ImageDataError(
            f"the sources mix the embodiments {' and '.join(names)}: pass mixed=True (koap embed --mixed) if that is"
            " meant"
        )
    if align_to is not None and (align_to not in names or len(names) < 2):
        raise ImageDataError(
            f"nothing can be aligned to the embodiment {align_to!r}: the sources have {' and '.join(names)}"
        )
    together = [episode for episodes in read for episode in episodes]
    embeddings = []
    for episode in together:
        embedding = encoder.embed(torch.from_numpy(episode.frames)).float()
        if embedding.shape[1] + episode.state.shape[1] != task.observation_dim:
            raise ValueError(
                f"task {task.name!r} observes {task.observation_dim} columns, embedding and recording have"
                f" {embedding.shape[1]} and {episode.state.shape[1]}"
            )
        embeddings.append(embedding)
    if align_to is not None:
        embeddings = _aligned(embeddings, [episode.embodiment for episode in together], align_to)
    for episode, embedding in zip(together, embeddings, strict=True):
        seen = np.concatenate([embedding.numpy(), episode.state], axis=1)
        states.append(torch.from_numpy(seen))
        missing = np.full((len(episode), task.action_dim), np.nan, dtype=np.float32)
        actions.append(torch.from_numpy(missing if episode.action is None else episode.action))
        whose.append(episode.embodiment)
    notes = {"embodiments": whose, "encoder": encoder.identity}
    if align_to is not None:
        notes["aligned_to"] = align_to
    return save_ted(flatten_trajectories(states, actions), Path(out) / "ted", task=task.name, notes=notes).parent


def _aligned(embeddings: list[Tensor], whose: list[str], to: str) -> list[Tensor]:
    """Embeddings of every demonstration as if one embodiment had moved in all of them."""
    out = list(embeddings)
    target = [part for part, name in zip(embeddings, whose, strict=True) if name == to]
    for other in sorted(set(whose) - {to}):
        rows = [row for row, name in enumerate(whose) if name == other]
        alignment = fit_alignment([embeddings[row] for row in rows], target)
        for row in rows:
            out[row] = alignment(embeddings[row])
    return out
