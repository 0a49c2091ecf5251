# This source code is licensed under the MIT license found in the LICENSE file.
"""Trajectories by the thousand become flat steps on disk: memory holds a part of them at a time.

::

    trajectories --> some ten thousand steps --> folder/part-0, part-1, ... --> folder/all, one after the other
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_koap.data.trajectories import flatten_trajectories

PART = 1 << 16  # steps that are held in memory at a time, and those of one trajectory more


def flatten_on_disk(
    trajectories: Iterable[tuple[torch.Tensor, torch.Tensor]],
    folder: str | Path,
    *,
    dtype: torch.dtype = torch.float32,
    finish: Callable[[TensorDictBase], TensorDictBase] | None = None,
    part: int = PART,
) -> TensorDictBase:
    """Lays trajectories one after the other in the storage layout, in files.

    Args:
        trajectories (iterable): of each trajectory its frames ``[T_i, obs]`` and actions ``[T_i - 1, act]``; asked for
            one by one.
        folder (str or Path): folder for the files, empty or to be created.

    Keyword Args:
        dtype (torch.dtype): floating type of the entries.
        finish (callable, optional): adds entries to the steps ``[M]`` of whole trajectories, such as ``state``.
        part (int): steps that are held in memory at a time, at least.

    Returns:
        TensorDict: flat memory-mapped data ``[sum(T_i - 1)]``, as of
        :func:`~torchrl_koap.data.flatten_trajectories`.

    Raises:
        ValueError: if there are no trajectories, or one does not fit as
            :func:`~torchrl_koap.data.flatten_trajectories` says.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.data.steps_on_disk import flatten_on_disk
        >>> arm = ((torch.full((4, 2), float(index)), torch.zeros(3, 1)) for index in range(5))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     flatten_on_disk(arm, folder, part=6)["episode"].tolist()
        [0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]
    """
    folder, first = Path(folder), 0
    lengths: list[int] = []
    for index, group in enumerate(_groups(iter(trajectories), part)):
        steps = flatten_trajectories(*zip(*group, strict=True), dtype=dtype, first=first)
        steps = steps if finish is None else finish(steps)
        join_on_disk([steps], len(steps), folder / f"part-{index}")
        first += len(group)
        lengths.append(len(steps))
    if not lengths:
        raise ValueError("there are no trajectories")
    parts = (TensorDict.load_memmap(folder / f"part-{index}", allow_pickle=False) for index in range(len(lengths)))
    return join_on_disk(parts, sum(lengths), folder / "all")


def join_on_disk(parts: Iterable[TensorDictBase], steps: int, folder: str | Path) -> TensorDictBase:
    """Writes flat data that come in parts into one memory-mapped tensordict.

    Args:
        parts (iterable of TensorDictBase): flat data ``[M_i]`` of the same entries.
        steps (int): steps of them all.
        folder (str or Path): folder to write, in tensordict's own layout.

    Raises:
        ValueError: if the parts have another number of steps.
        OSError: if there is no place for them on the disk.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data.steps_on_disk import join_on_disk
        >>> parts = [TensorDict({"action": torch.full((2, 1), float(index))}, [2]) for index in range(2)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     join_on_disk(parts, 4, folder)["action"].flatten()
        tensor([0., 0., 1., 1.])
    """
    parts = iter(parts)
    head, begin = next(parts), 0
    whole = head[:1].clone().expand(steps).memmap_like(folder)
    _reserve(Path(folder))
    for part in itertools.chain([head], parts):
        if begin + len(part) > steps:
            raise ValueError(f"the parts have more than {steps} steps")
        whole[begin : begin + len(part)] = part
        begin += len(part)
    if begin < steps:
        raise ValueError(f"the parts have {begin} steps, wanted {steps}")
    return whole


def _reserve(folder: Path) -> None:
    """Takes the place on the disk at once: a write into a mapped file that finds none ends the process (SIGBUS)."""
    if not hasattr(os, "posix_fallocate"):
        return
    for path in sorted(folder.rglob("*.memmap")):
        with path.open("rb+") as file:
            try:
                os.posix_fallocate(file.fileno(), 0, max(path.stat().st_size, 1))
            except OSError as error:
                raise OSError(error.errno, error.strerror, str(path)) from None


def _groups(trajectories: Iterator, least: int) -> Iterator[list]:
    """Trajectories in groups of that many steps or a few more; the last group has what is left."""
    group, steps = [], 0
    for frames, actions in trajectories:
        group.append((frames, actions))
        steps += len(frames)
        if steps >= least:
            yield group
            group, steps = [], 0
    if group:
        yield group
