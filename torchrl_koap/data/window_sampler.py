# This source code is licensed under the MIT license found in the LICENSE file.
"""Sampling windows as ``[B, T]`` straight from flat storage, a fixed number of them with labels.

A *sampler* draws numbers of windows, a *sample unit* turns each into ``T`` storage indices. Because the index is
two-dimensional, the storage gives back a batch ``[B, T]`` without reshaping or bookkeeping; TorchRL's own unit
``Sequence`` and its ``SliceSampler`` give flat batches ``[B * T]``, know no padding and no strata. Every window is
equally likely, however long its trajectory.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torchrl.data import RandomSampler, Storage
from torchrl.data.replay_buffers import SampleUnit

from torchrl_koap.keys import PADDED


class WindowUnit(SampleUnit):
    """Turns numbers of windows ``[B]`` into storage indices ``[B, T]``, by :meth:`WindowTable.frames`.

    With ``padded`` bool ``[B, T]``, which of them are padded, is the entry ``padded`` of the sample's info.
    """

    def __init__(self, frames: Callable[[Tensor], tuple[Tensor, Tensor]], *, padded: bool = False):
        self._frames, self._padded = frames, padded

    def expand(self, index: Tensor, info: dict[str, Any], storage: Storage | None) -> tuple[Tensor, dict[str, Any]]:
        """Storage indices ``[B, T]`` of the windows ``[B]``, and ``info`` with ``padded`` where it is handed out."""
        frames, padded = self._frames(index)
        return frames, info | {PADDED: padded} if self._padded else info


class WindowSampler(RandomSampler):
    """Draws windows with replacement, each equally likely.

    Draws come from the global torch generator (of the table's device), unless the buffer was given its own, so that
    ``torchrl.checkpoint.GlobalRNGState`` makes a resumed run draw the same windows; the sampler itself has no state.

    Args:
        labelled (Tensor): bool ``[M]``, which windows have a label on an inner frame (``WindowTable.labelled``).

    Keyword Args:
        labelled_share (float, optional): in a batch of ``B``, ``round(labelled_share * B)`` windows (half up) have a
            label and come first; the others have none, as far as such windows exist. A fixed number keeps the variance
            of the label loss down, and equal on every rank of a distributed run. Default: windows are drawn without
            regard to labels.

    Raises:
        ValueError: for a share outside (0, 1], or if labelled windows are asked for and there are none.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import WindowSampler
        >>> sampler = WindowSampler(torch.tensor([False, True, False]), labelled_share=0.5)
        >>> sampler.sample(None, 4)[0][:2]
        tensor([1, 1])
    """

    def __init__(self, labelled: Tensor, *, labelled_share: float | None = None):
        if labelled_share is not None and not 0 < labelled_share <= 1:
            raise ValueError(f"labelled_share must be in (0, 1], got {labelled_share}")
        if labelled_share is not None and not labelled.any():
            raise ValueError(
                f"labelled_share is {labelled_share}, but none of the {len(labelled)} windows has a label on an inner"
                " frame; leave labelled_share out to train without labels"
            )
        self.labelled_share = labelled_share
        everything = torch.arange(len(labelled), device=labelled.device)
        stratified = labelled_share is not None
        self._labelled = everything[labelled] if stratified else everything[:0]
        self._others = everything[~labelled] if stratified and not labelled.all() else everything

    def number_labelled(self, batch_size: int) -> int:
        """Number of windows of a batch that have a label.

        Raises:
            ValueError: if the share of a batch of that size is no window at all.
        """
        if self.labelled_share is None:
            return 0
        number = math.floor(self.labelled_share * batch_size + 0.5)
        if number == 0:
            raise ValueError(f"labelled_share {self.labelled_share} of a batch of {batch_size} is no window at all")
        return number

    def sample(self, storage: Storage | None, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draws numbers of windows, int64 ``[batch_size]``."""
        number = self.number_labelled(batch_size)
        if self.labelled_share is None:
            return self._draw(self._others, batch_size), {}
        return torch.cat([self._draw(self._labelled, number), self._draw(self._others, batch_size - number)]), {}

    def _draw(self, choices: Tensor, number: int) -> Tensor:
        device = choices.device if self._rng is None else self._rng.device
        drawn = torch.randint(len(choices), (number,), device=device, generator=self._rng)
        return choices[drawn.to(choices.device)]
