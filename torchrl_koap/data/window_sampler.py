# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows of consecutive steps, sampled as ``[B, T]`` straight from flat storage.

A *sampler* draws where windows start, a *sample unit* turns each start into ``T`` storage indices. Because the index is
two-dimensional, the storage gives back a batch ``[B, T]`` without reshaping or bookkeeping. The possible starts are
tabulated once (:class:`WindowTable`); every window is equally likely, however long its trajectory.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Literal

import torch
from safetensors.torch import load_file, save_file
from torchrl.data import Storage
from torchrl.data.replay_buffers import SampleUnit
from torchrl.data.replay_buffers.samplers import Sampler

from torchrl_koap.data.window_table import WindowTable, check_window

PADDED = "padded"
_FIRST, _LAST = "window_first", "window_last"


class WindowUnit(SampleUnit):
    """Turns starts ``[B]`` into storage indices ``[B, T]``.

    Frames outside the trajectory repeat its first or last step; the entry ``padded [B, T]`` of the sample's info tells
    which. A transition is recorded, rather than made up, where neither its frame nor the next one is padded.

    Args:
        window (int): frames per window.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import WindowUnit
        >>> WindowUnit(3).expand(torch.tensor([0, 7]), {}, None)[0]
        tensor([[0, 1, 2],
                [7, 8, 9]])
    """

    def __init__(self, window: int):
        self.window = window
        self._frames = torch.arange(window)

    def expand(
        self, index: torch.Tensor, info: dict[str, Any], storage: Storage | None
    ) -> tuple[torch.Tensor, dict[str, Any]]:
        """Storage indices ``[B, T]`` of windows that begin at ``[B]``.

        Args:
            index (Tensor): storage index of frame 0 of every window, int64 ``[B]``.
            info (dict): what the sampler handed over; the bounds of the windows' trajectories are taken out of it.
            storage (Storage, optional): not looked at.

        Returns:
            tuple: the indices, and ``info`` with ``padded`` (bool ``[B, T]``) where it held bounds.
        """
        if self._frames.device != index.device:
            self._frames = self._frames.to(index.device)
        index = index.unsqueeze(-1) + self._frames
        if _FIRST in info:
            inside = index.clamp(info[_FIRST].unsqueeze(-1), info[_LAST].unsqueeze(-1))
            info = {key: value for key, value in info.items() if key not in (_FIRST, _LAST)}
            info[PADDED] = inside != index
            index = inside
        return index, info


class WindowSampler(Sampler):
    """Draws windows with replacement, each equally likely.

    Draws come from the global torch generator (of the storage's device), unless the buffer was given its own, so
    ``torchrl.checkpoint.GlobalRNGState`` makes a resumed run draw the same windows.

    Args:
        window (int): frames per window.
        history (int): frames up to and including "now"; tells which frames' labels count.
        labelled_share (float, optional): in a batch of ``B``, ``round(labelled_share * B)`` windows (half up) have a
            label on an inner frame and come first; the others have none, as far as such windows exist. A fixed number
            keeps the variance of the label loss down, and equal on every rank of a distributed run. Default: windows
            are drawn without regard to labels.
        pad_before, pad_after, short: see :meth:`WindowTable.build`.
        table (WindowTable, optional): windows tabulated beforehand. Default: tabulated from the storage, again whenever
            the buffer writes to it.

    Raises:
        ValueError: if an argument is out of range; at sampling, if a trajectory is too short or if labelled windows
            are asked for and there are none.

    Examples:
        >>> import torch
        >>> from torchrl.data import ReplayBuffer, TensorStorage
        >>> from torchrl_koap.data import WindowSampler, flatten_trajectories
        >>> data = flatten_trajectories([torch.rand(21, 4)] * 3, [torch.rand(20, 2)] * 3)
        >>> sampler = WindowSampler(16)
        >>> buffer = ReplayBuffer(
        ...     storage=TensorStorage(data), sampler=sampler, sample_unit=sampler.unit(), batch_size=8
        ... )
        >>> buffer.sample()["observation"].shape
        torch.Size([8, 16, 4])
    """

    _table: WindowTable | None
    _pools: tuple[torch.Tensor, ...]

    def __init__(
        self,
        window: int,
        *,
        history: int = 2,
        labelled_share: float | None = None,
        pad_before: int = 0,
        pad_after: int = 0,
        short: Literal["error", "drop"] = "error",
        table: WindowTable | None = None,
    ):
        check_window(window, history, pad_before, pad_after, short)
        if labelled_share is not None and not 0 < labelled_share <= 1:
            raise ValueError(f"labelled_share must be in (0, 1], got {labelled_share}")
        self.window, self.history, self.short = window, history, short
        self.pad_before, self.pad_after = pad_before, pad_after
        self.labelled_share = labelled_share
        self._given = table
        self._empty()

    def unit(self) -> WindowUnit:
        """The sample unit that belongs to this sampler."""
        return WindowUnit(self.window)

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict[str, Any]]:
        """Draws where ``batch_size`` windows start.

        Args:
            storage (Storage): flat data ``[N]``.
            batch_size (int): number ``B`` of windows.

        Returns:
            tuple: storage indices of frame 0, int64 ``[B]``, and a dict with the bounds of their trajectories where
            frames are padded.
        """
        self._prepare(storage)
        if self.labelled_share is None:
            drawn = self._draw(0, batch_size)
        else:
            number = self._number_labelled(batch_size)
            drawn = torch.cat([self._draw(1, number), self._draw(0, batch_size - number)])
        table = self._table
        info = {}
        if self.pad_before or self.pad_after:
            info = {_FIRST: table.first[drawn], _LAST: table.last[drawn]}
        return table.starts[drawn], info

    def check(self, storage: Storage, batch_size: int) -> None:
        """Finds out, without drawing, whether batches of this size can be drawn.

        Args:
            storage (Storage): flat data ``[N]``.
            batch_size (int): number of windows per batch.

        Raises:
            ValueError: if they cannot.
        """
        self._prepare(storage)
        if self.labelled_share is not None:
            self._number_labelled(batch_size)

    def _prepare(self, storage: Storage) -> None:
        """Tabulates the windows, and sorts them into those of the label-free pool 0 and the labelled pool 1."""
        if self._table is not None and self._table.num_steps == len(storage):
            return
        if self._given is not None:
            if self._given.num_steps != len(storage):
                given, stored = self._given.num_steps, len(storage)
                raise ValueError(f"the window table is for {given} steps, the storage has {stored}")
            self._table = self._given
        else:
            options = {name: getattr(self, name) for name in ("history", "pad_before", "pad_after", "short")}
            self._table = WindowTable.build(storage.get(slice(None)), self.window, **options)
        everything = torch.arange(len(self._table.starts), device=self._table.starts.device)
        if self.labelled_share is None:
            self._pools = (everything, everything[:0])
            return
        labelled = self._table.labelled
        if not labelled.any():
            raise ValueError(
                f"labelled_share is {self.labelled_share}, but none of the {len(labelled)} windows has a label on an"
                " inner frame; leave labelled_share out to train without labels"
            )
        self._pools = (everything if labelled.all() else everything[~labelled], everything[labelled])

    def _number_labelled(self, batch_size: int) -> int:
        number = math.floor(self.labelled_share * batch_size + 0.5)
        if number == 0:
            raise ValueError(f"labelled_share {self.labelled_share} of a batch of {batch_size} is no window at all")
        return number

    def _draw(self, pool: int, number: int) -> torch.Tensor:
        choices = self._pools[pool]
        return choices[self._random(torch.randint, len(choices), (number,))]

    def _random(self, function, *args) -> torch.Tensor:
        device = self._table.starts.device
        if self._rng is None:
            return function(*args, device=device)
        return function(*args, device=self._rng.device, generator=self._rng).to(device)

    def add(self, index: int) -> None:
        """Forgets the table, because the storage was written to."""
        self._table = None

    def extend(self, index: torch.Tensor) -> None:
        """Forgets the table, because the storage was written to."""
        self._table = None

    def _empty(self) -> None:
        self._table = None
        self._pools = ()

    def _options(self) -> dict[str, Any]:
        share = -1.0 if self.labelled_share is None else float(self.labelled_share)
        return {
            "window": self.window,
            "history": self.history,
            "pad_before": self.pad_before,
            "pad_after": self.pad_after,
            "labelled_share": share,
        }

    def state_dict(self) -> dict[str, Any]:
        """The options, which :meth:`load_state_dict` compares, and where an epoch stands."""
        return self._options()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues from a state.

        Raises:
            ValueError: if the state is that of a sampler with other options.
        """
        wrong = [
            f"{name} {float(state_dict[name]):g} (here {value:g})"
            for name, value in self._options().items()
            if float(state_dict[name]) != value
        ]
        if wrong:
            raise ValueError("the saved window sampler has other options: " + ", ".join(wrong))
        self._empty()

    def dumps(self, path: str | Path) -> None:
        """Saves the state in a folder, as JSON and safetensors."""
        path = Path(path)
        path.mkdir(parents=True, exist_ok=True)
        state = self.state_dict()
        tensors = {name: value.cpu() for name, value in state.items() if isinstance(value, torch.Tensor)}
        save_file(tensors, path / "window_sampler.safetensors")
        scalars = {name: value for name, value in state.items() if name not in tensors}
        (path / "window_sampler.json").write_text(json.dumps(scalars))

    def loads(self, path: str | Path) -> None:
        """Continues from a state that :meth:`dumps` saved."""
        path = Path(path)
        scalars = json.loads((path / "window_sampler.json").read_text())
        self.load_state_dict({**scalars, **load_file(path / "window_sampler.safetensors")})

    def __repr__(self) -> str:
        return f"{type(self).__name__}(" + ", ".join(f"{name}={value}" for name, value in self._options().items()) + ")"
