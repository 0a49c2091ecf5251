# This source code is licensed under the MIT license found in the LICENSE file.
"""A replay buffer of windows in one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, TensorDictReplayBuffer, TensorStorage

from torchrl_koap.data.window_sampler import WindowSampler
from torchrl_koap.data.window_sampler_without_replacement import WindowSamplerWithoutReplacement
from torchrl_koap.data.window_table import WindowTable


def make_window_buffer(
    data: TensorDictBase | ReplayBuffer,
    window: int,
    batch_size: int,
    *,
    select: Sequence[NestedKey] | None = None,
    replacement: bool = True,
    drop_last: bool = True,
    device: torch.device | str | None = None,
    prefetch: int | None = None,
    **options: Any,
) -> ReplayBuffer:
    """A replay buffer of windows over flat data.

    Args:
        data (TensorDictBase or ReplayBuffer): flat data ``[N]``, in memory, memory-mapped or on a GPU, or a buffer
            over such data, for example a :class:`D3ILExperienceReplay`. Not copied.
        window (int): frames per window.
        batch_size (int): windows per batch.
        select (sequence of keys, optional): the entries to return; the fewer the faster. Default: all.
        replacement (bool): draw with replacement, or in epochs.
        drop_last (bool): see :class:`WindowSamplerWithoutReplacement`.
        device (optional): move the data there first. Default: where they are.
        prefetch (int, optional): batches that threads draw ahead, with replacement only: they would draw beyond the end
            of an epoch. The threads share torch's global generator with whatever else draws from it meanwhile, so that
            a run is not repeated bit for bit. Default: none.
        **options: ``history``, ``labelled_share``, ``pad_before``, ``pad_after``, ``short``: see
            :class:`WindowSampler`.

    Returns:
        ReplayBuffer: samples are tensordicts ``[batch_size, window]``. With padding, a
        :class:`~torchrl.data.TensorDictReplayBuffer` whose samples also hold ``padded`` and ``index``.

    Raises:
        KeyError: if a selected entry does not exist.
        ValueError: if an option is out of range, prefetching is asked for in epochs, a trajectory is too short for a
            window, or labelled windows are asked
            for and there are none.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import LabelBudget, flatten_trajectories, make_window_buffer
        >>> data = flatten_trajectories([torch.rand(61, 4)] * 10, [torch.rand(60, 2)] * 10)
        >>> data, _ = LabelBudget(2).apply(data)
        >>> entries = ["observation", "action", "has_action"]
        >>> buffer = make_window_buffer(data, 16, 8, select=entries, labelled_share=0.25)
        >>> batch = buffer.sample()
        >>> batch.shape, int(batch["has_action"].any(1).sum())
        (torch.Size([8, 16]), 2)
    """
    if isinstance(data, ReplayBuffer):
        data = data.storage.get(slice(None))
    if data.batch_dims != 1:
        raise ValueError(f"windows are cut from flat data [N], got batch size {list(data.batch_size)}")
    if prefetch is not None and (prefetch < 1 or not replacement):
        wanted = "prefetch must be >= 1" if prefetch < 1 else "an epoch (replacement=False) cannot be prefetched"
        raise ValueError(f"{wanted}, got prefetch={prefetch}")
    if device is not None:
        data = data.to(device)
    table_options = {name: options[name] for name in ("history", "pad_before", "pad_after", "short") if name in options}
    table = WindowTable.build(data, window, **table_options)
    if select is not None:
        absent = [key for key in select if data.get(key, None) is None]
        if absent:
            raise KeyError(f"the data have no entries {absent}")
        data = data.select(*select)
    if replacement:
        sampler = WindowSampler(window, table=table, **options)
    else:
        sampler = WindowSamplerWithoutReplacement(window, table=table, drop_last=drop_last, **options)
    storage = TensorStorage(data)
    sampler.check(storage, batch_size)
    buffer_class = TensorDictReplayBuffer if sampler.pad_before or sampler.pad_after else ReplayBuffer
    return buffer_class(
        storage=storage,
        sampler=sampler,
        sample_unit=sampler.unit(),
        writer=ImmutableDatasetWriter(),
        batch_size=batch_size,
        prefetch=prefetch,
    )


def cut_windows(
    data: TensorDictBase, window: int, *, select: Sequence[NestedKey] | None = None, pad_before: int = 0
) -> TensorDictBase:
    """All windows of flat data at once.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``episode``.
        window (int): frames per window.
        select (sequence of keys, optional): the entries to return. Default: all.
        pad_before (int): frames by which a window may begin before its trajectory; they repeat its first frame.

    Returns:
        TensorDictBase: ``[M, window]`` in the order of the data, with ``padded`` ``[M, window, 1]``.

    Raises:
        ValueError: if a trajectory is too short for a window.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import cut_windows
        >>> data = TensorDict({"state": torch.arange(4.0)[:, None], "episode": torch.zeros(4, dtype=torch.int64)}, [4])
        >>> cut_windows(data, 3, pad_before=1)["state"].squeeze(-1).tolist()
        [[0.0, 0.0, 1.0], [0.0, 1.0, 2.0], [1.0, 2.0, 3.0]]
    """
    table = WindowTable.build(data, window, pad_before=pad_before)
    frames = table.starts[:, None] + torch.arange(window, device=table.starts.device)
    inside = frames.clamp(table.first[:, None], table.last[:, None])
    windows = (data if select is None else data.select(*select))[inside]
    return windows.set("padded", (frames != inside).unsqueeze(-1))
