# This source code is licensed under the MIT license found in the LICENSE file.
"""Windows drawn once per epoch, in a new order each time."""

from __future__ import annotations

from typing import Any

import torch
from torchrl.data import Storage

from torchrl_koap.data.window_sampler import WindowSampler


class WindowSamplerWithoutReplacement(WindowSampler):
    """Draws every window once per epoch, in a new order each time.

    With ``labelled_share`` an epoch is one pass over the windows without labels; the labelled ones go round beside it,
    in their own shuffled order, as often as needed.

    Args:
        window (int): frames per window.
        drop_last (bool): leave out the rest of an epoch that does not fill a batch, or return it as a smaller batch.
        **options: as in :class:`WindowSampler`.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories, make_window_buffer
        >>> data = flatten_trajectories([torch.rand(21, 4)] * 3, [torch.rand(20, 2)] * 3)
        >>> buffer = make_window_buffer(data, 16, 5, replacement=False)
        >>> len(list(buffer))  # 3 trajectories x 5 windows
        3
    """

    def __init__(self, window: int, *, drop_last: bool = True, **options: Any):
        self.drop_last = drop_last
        super().__init__(window, **options)

    @property
    def ran_out(self) -> bool:
        """Whether the epoch is over."""
        return self._ran_out

    @ran_out.setter
    def ran_out(self, value: bool) -> None:
        self._ran_out = value

    def _draw(self, pool: int, number: int) -> torch.Tensor:
        choices = self._pools[pool]
        if number == 0:
            return choices[:0]
        paces = pool == self._pace
        drawn = []
        while number > 0:
            order = self._orders[pool]
            if order is None or len(order) != len(choices) or self._cursors[pool] >= len(order):
                order = self._orders[pool] = self._random(torch.randperm, len(choices))
                self._cursors[pool] = 0
            begin = self._cursors[pool]
            drawn.append(order[begin : begin + number].to(choices.device))
            self._cursors[pool] += len(drawn[-1])
            number -= len(drawn[-1])
            if paces:
                left = len(choices) - self._cursors[pool]
                self._ran_out = left == 0 or (self.drop_last and left < self._needed)
                if self._ran_out:
                    self._orders[pool] = None
                break
        return choices[torch.cat(drawn)]

    def check(self, storage: Storage, batch_size: int) -> None:
        """Finds out, without drawing, whether batches of this size can be drawn.

        Args:
            storage (Storage): flat data ``[N]``.
            batch_size (int): number of windows per batch.

        Raises:
            ValueError: if they cannot.
        """
        super().check(storage, batch_size)
        self._pace, self._needed = self._pace_of(batch_size)
        if self.drop_last and self._needed > len(self._pools[self._pace]):
            available = len(self._pools[self._pace])
            raise ValueError(f"a batch needs {self._needed} different windows, there are {available}")

    def sample(self, storage: Storage, batch_size: int) -> tuple[torch.Tensor, dict[str, Any]]:
        """Draws where the next ``batch_size`` windows of the epoch start.

        Args:
            storage (Storage): flat data ``[N]``.
            batch_size (int): number ``B`` of windows.

        Returns:
            tuple: as of :meth:`WindowSampler.sample`.

        Raises:
            ValueError: as :meth:`check`.
        """
        self.check(storage, batch_size)
        return super().sample(storage, batch_size)

    def _pace_of(self, batch_size: int) -> tuple[int, int]:
        """The pool whose passes are the epochs, and how many windows of a batch come from it."""
        if self.labelled_share is None:
            return 0, batch_size
        rest = batch_size - self._number_labelled(batch_size)
        return (0, rest) if rest else (1, batch_size)

    def _empty(self) -> None:
        super()._empty()
        self._orders: list[torch.Tensor | None] = [None, None]
        self._cursors = [0, 0]
        self._pace, self._needed = 0, 0
        self._ran_out = False

    def state_dict(self) -> dict[str, Any]:
        """The options, and the order and position of the epoch under way."""
        state = {**super().state_dict(), "ran_out": self._ran_out}
        for pool, order in enumerate(self._orders):
            state[f"order_{pool}"] = torch.empty(0, dtype=torch.int64) if order is None else order.clone()
            state[f"cursor_{pool}"] = self._cursors[pool]
        return state

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continues an epoch where it stood."""
        super().load_state_dict(state_dict)
        self._ran_out = bool(state_dict["ran_out"])
        for pool in range(2):
            order = state_dict[f"order_{pool}"]
            self._orders[pool] = order.clone() if len(order) else None
            self._cursors[pool] = int(state_dict[f"cursor_{pool}"])
