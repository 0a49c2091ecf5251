# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows of consecutive steps: their table, all of them at once, or a replay buffer over them.

In the buffer a *sampler* draws numbers of windows, a *sample unit* turns each into ``T`` storage indices. TorchRL's own
unit ``Sequence`` and its ``SliceSampler`` give flat batches ``[B * T]``, without padding or stratification.

With ``pad_before`` and ``pad_after`` windows may extend that many frames beyond the ends of their trajectory. The first
or last step is repeated there::

    steps of the trajectory                0 1 2 3 4
    window 3, no padding                   0 1 2 ... 2 3 4
    window 3, pad_before 1, pad_after 1    0 0 1 ... 3 4 4
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import (
    ImmutableDatasetWriter,
    RandomSampler,
    ReplayBuffer,
    Storage,
    TensorDictReplayBuffer,
    TensorStorage,
)
from torchrl.data.replay_buffers import SampleUnit

from torchrl_koap import keys
from torchrl_koap.data.trajectories import begins
from torchrl_koap.files import some

Rows = TypeVar("Rows", Tensor, TensorDictBase)


@dataclass(frozen=True)
class WindowTable:
    """All windows of a data set.

    A window is *labelled* if a counted frame has an action label and neither that frame nor the next one is padded.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import WindowTable, flatten_trajectories
        >>> table = WindowTable.build(flatten_trajectories([torch.rand(6, 2)] * 2, [torch.rand(5, 1)] * 2), 4)
        >>> table.starts.tolist(), table.last.tolist()
        ([0, 1, 5, 6], [4, 4, 9, 9])
        >>> table.frames(torch.tensor([1]))[0]
        tensor([[1, 2, 3, 4]])
    """

    starts: Tensor  # int64 [M], storage index of frame 0; outside the trajectory where frames are padded
    first: Tensor  # int64 [M], index of the first step of the window's trajectory
    last: Tensor  # int64 [M], index of its last step
    labelled: Tensor  # bool [M]
    window: int  # frames per window

    @classmethod
    def build(
        cls, data: TensorDictBase, window: int, *, counted: range | None = None, pad_before: int = 0, pad_after: int = 0
    ) -> WindowTable:
        """Tabulates the windows of ``window`` frames of flat data ``[N]``.

        The data need ``episode``; ``step_count`` and ``has_action`` are optional. Windows may begin ``pad_before``
        frames before their trajectory and end ``pad_after`` behind it; these frames repeat its first or last step. Only
        labels of the frames ``counted`` count; by default all but the first and the last frame.

        Raises:
            KeyError: if there is no ``episode``.
            ValueError: if the data or ``episode`` are not flat, an argument is out of range, or a trajectory is too
                short.
        """
        counted = range(1, window - 1) if counted is None else counted
        if window < 2 or not 0 <= counted.start <= counted.stop < window:
            raise ValueError(f"window must be >= 2 and counted exclude the last frame, got {window} and {counted}")
        for name, value in (("pad_before", pad_before), ("pad_after", pad_after)):
            if not 0 <= value < window:
                raise ValueError(f"{name} must be in 0..{window - 1} frames (less than the window), got {value}")
        episode = data[keys.EPISODE]
        if data.batch_dims != 1 or episode.ndim != 1:
            got = f"batch size {list(data.batch_size)} and {keys.EPISODE!r} {list(episode.shape)}"
            raise ValueError(f"windows are cut from flat data [N] with {keys.EPISODE!r} [N], got {got}")
        device, steps = episode.device, len(episode)
        new = begins(data)
        count = data.get(keys.STEP_COUNT, None)
        if count is not None:  # a trajectory with missing steps is split there
            count = count.reshape(-1)  # TorchRL's StepCounter counts in [N, 1]
            new[1:] |= count[1:] != count[:-1] + 1
        first = new.nonzero().squeeze(-1)
        lengths = torch.diff(first, append=torch.tensor([steps], device=device))
        windows = (lengths + pad_before + pad_after - window + 1).clamp_min(0)
        if (short := windows == 0).any():
            named = zip(episode[first][short].tolist(), lengths[short].tolist(), strict=True)
            raise ValueError(
                f"{int(short.sum())} of {len(lengths)} trajectories are shorter than a window"
                f" ({window - pad_before - pad_after} steps):"
                f" {some([f'{number} ({length} steps)' for number, length in named])}; leave them out"
                " (`koap convert --drop-short`)"
            )
        trajectory = torch.arange(len(first), device=device).repeat_interleave(windows)
        number = torch.arange(len(trajectory), device=device) - (windows.cumsum(0) - windows)[trajectory]
        starts = first[trajectory] - pad_before + number
        first, last = first[trajectory], (first + lengths - 1)[trajectory]
        labelled = torch.zeros_like(starts, dtype=torch.bool)
        has_action = data.get(keys.HAS_ACTION, None)
        if has_action is not None:
            before = torch.zeros(steps + 1, dtype=torch.int64, device=device)
            before[1:] = has_action.reshape(-1).cumsum(0)
            low = torch.maximum(starts + counted.start, first)
            high = torch.minimum(starts + counted.stop - 1, last - 1)
            labelled = before[(high + 1).clamp_min(0)] > before[low.clamp_max(steps)]
        return cls(starts, first, last, labelled, window)

    def frames(self, rows: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Returns the storage index of every frame of windows, padded at the ends of their trajectories.

        Args:
            rows (Tensor, optional): numbers of windows ``[M]``, or a bool mask. Default: all of them.

        Returns:
            tuple: indices, int64 ``[M, T]``, and padding, bool ``[M, T]``: True where a frame repeats the first or last
            step. A transition is recorded only if neither its frame nor the next one is padded.
        """
        starts, first, last = (value if rows is None else value[rows] for value in (self.starts, self.first, self.last))
        wanted = starts.unsqueeze(-1) + torch.arange(self.window, device=starts.device)
        inside = wanted.clamp(first.unsqueeze(-1), last.unsqueeze(-1))
        return inside, inside != wanted


class WindowUnit(SampleUnit):
    """Turns numbers of windows ``[B]`` into storage indices ``[B, T]``, by :meth:`WindowTable.frames`.

    With ``padded``, the sample's info has the entry ``padded``, bool ``[B, T]``: which frames are padded.

    Examples:
        >>> import torch
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_koap.data import WindowSampler, WindowTable, WindowUnit, flatten_trajectories
        >>> data = flatten_trajectories([torch.rand(9, 2)] * 3, [torch.rand(8, 1)] * 3)
        >>> table = WindowTable.build(data, 4)
        >>> options = {"sampler": WindowSampler(table.labelled), "sample_unit": WindowUnit(table.frames)}
        >>> buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(data)), batch_size=5, **options)
        >>> _ = buffer.extend(data)
        >>> buffer.sample().shape
        torch.Size([5, 4])
    """

    def __init__(self, frames: Callable[[Tensor], tuple[Tensor, Tensor]], *, padded: bool = False):
        self._frames, self._padded = frames, padded

    def expand(self, index: Tensor, info: dict[str, Any], storage: Storage | None) -> tuple[Tensor, dict[str, Any]]:
        """Returns storage indices ``[B, T]`` of the windows ``[B]``, and ``info``, with ``padded`` if requested."""
        frames, padded = self._frames(index)
        return frames, info | {keys.PADDED: padded} if self._padded else info


class WindowSampler(RandomSampler):
    """Draws windows with replacement, each equally likely.

    Uses the global torch generator of the table's device, unless the buffer has its own.

    Args:
        labelled (Tensor): bool ``[M]``, which windows have a label on an inner frame (``WindowTable.labelled``).

    Keyword Args:
        labelled_share (float, optional): the first ``round(labelled_share * B)`` windows (half up) of a batch of ``B``
            have a label; the others have none, if such windows exist. Default: labels do not affect the draw.

    Raises:
        ValueError: if ``labelled_share`` is outside (0, 1], or is given and no window has a label.

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
                " frame; omit labelled_share to train without labels"
            )
        self.labelled_share = labelled_share
        everything = torch.arange(len(labelled), device=labelled.device)
        apart = labelled_share is not None and not labelled.all()
        self._labelled, self._others = everything[labelled], everything[~labelled] if apart else everything

    def number_labelled(self, batch_size: int) -> int:
        """Returns the number of windows of a batch that have a label.

        Raises:
            ValueError: if the share of such a batch rounds to no window.
        """
        if self.labelled_share is None:
            return 0
        number = math.floor(self.labelled_share * batch_size + 0.5)
        if number == 0:
            raise ValueError(f"labelled_share {self.labelled_share} of a batch of {batch_size} rounds to 0 windows")
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


def spread_evenly(rows: Rows, most: int) -> Rows:
    """Returns at most ``most`` of the rows, spread evenly from the first to the last."""
    if len(rows) <= most:
        return rows
    last = len(rows) - 1  # may be rounded up
    return rows[torch.linspace(0, last, most).round().long().clamp_max(last)]


def cut_windows(
    data: TensorDictBase,
    window: int,
    *,
    select: Sequence[NestedKey] | None = None,
    pad_before: int = 0,
    labelled_frame: int | None = None,
    most: int | None = None,
) -> TensorDictBase:
    """Cuts windows of flat data at once: all, or some that are spread evenly over the data.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``episode``.
        window (int): frames per window.
        select (sequence of keys, optional): the entries to return. Default: all.
        pad_before (int): frames by which a window may begin before its trajectory; they repeat its first frame.
        labelled_frame (int, optional): cut only windows with a label on this frame. Default: all.
        most (int, optional): largest number of windows. All of them take ``window`` times the memory of the data.

    Returns:
        TensorDictBase: ``[M, window]`` in the order of the data, with ``padded`` ``[M, window, 1]``.

    Raises:
        KeyError, ValueError: as :meth:`WindowTable.build`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import cut_windows
        >>> data = TensorDict({"state": torch.arange(4.0)[:, None], "episode": torch.zeros(4, dtype=torch.int64)}, [4])
        >>> cut_windows(data, 3, pad_before=1)["state"].squeeze(-1).tolist()
        [[0.0, 0.0, 1.0], [0.0, 1.0, 2.0], [1.0, 2.0, 3.0]]
    """
    table = WindowTable.build(data, window, pad_before=pad_before)
    rows = torch.arange(len(table.starts), device=table.starts.device)
    if labelled_frame is not None:
        steps = (table.starts + labelled_frame).clamp(table.first, table.last)
        rows = rows[data[keys.HAS_ACTION].squeeze(-1)[steps]]
    frames, padded = table.frames(rows if most is None else spread_evenly(rows, most))
    windows = (data if select is None else data.select(*select))[frames]
    return windows.set("padded", padded.unsqueeze(-1))


def make_window_buffer(
    data: TensorDictBase | ReplayBuffer,
    window: int,
    batch_size: int,
    *,
    select: Sequence[NestedKey] | None = None,
    labelled_share: float | None = None,
    counted: range | None = None,
    pad_before: int = 0,
    pad_after: int = 0,
) -> ReplayBuffer:
    """Makes a replay buffer of windows over flat data.

    Args:
        data (TensorDictBase or ReplayBuffer): flat data ``[N]``, in memory or on a GPU, or a buffer over such data, for
            example a :class:`D3ILExperienceReplay`. Not copied.
        window (int): frames per window.
        batch_size (int): windows per batch.
        select (sequence of keys, optional): the entries to return; fewer are faster. Default: all.
        labelled_share (float, optional): see :class:`WindowSampler`.
        counted, pad_before, pad_after: see :meth:`WindowTable.build`.

    Returns:
        ReplayBuffer: samples are tensordicts ``[batch_size, window]``. With padding, a
        :class:`~torchrl.data.TensorDictReplayBuffer` whose samples also hold ``padded`` and ``index``.

    Raises:
        KeyError: if a selected entry does not exist.
        ValueError: if an option is out of range, or a trajectory is too short for a window.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import LabelBudget, flatten_trajectories, make_window_buffer
        >>> data = flatten_trajectories([torch.rand(61, 4)] * 10, [torch.rand(60, 2)] * 10)
        >>> data, _ = LabelBudget(count=2).apply(data)
        >>> entries = ["observation", "action", "has_action"]
        >>> buffer = make_window_buffer(data, 16, 8, select=entries, labelled_share=0.25)
        >>> batch = buffer.sample()
        >>> batch.shape, int(batch["has_action"].any(1).sum())
        (torch.Size([8, 16]), 2)
    """
    if isinstance(data, ReplayBuffer):
        data = data.storage.get(slice(None))
    table = WindowTable.build(data, window, counted=counted, pad_before=pad_before, pad_after=pad_after)
    if select is not None:
        data = data.select(*select)
    sampler = WindowSampler(table.labelled, labelled_share=labelled_share)
    sampler.number_labelled(batch_size)  # raises if the share rounds to 0 windows
    padded = bool(pad_before or pad_after)
    return (TensorDictReplayBuffer if padded else ReplayBuffer)(
        storage=TensorStorage(data),
        sampler=sampler,
        sample_unit=WindowUnit(table.frames, padded=padded),
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
    )
