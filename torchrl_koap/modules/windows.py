# This source code is licensed under the MIT license found in the LICENSE file.
"""Defines which frames of a window a controller reads for each frame, and which frames count in a loss.

With ``num_past = 1`` frame before the present one, look-ahead ``k = 8`` and a window of ``T = 16`` frames::

    frame t            1         2        ...  7         8         ...  13        14          15
    f reads            x_0,x_1   x_1,x_2       x_6,x_7   x_7,x_8        x_12,x_13 x_13,x_14   x_14,x_15
    and x_{t+k}        x_9       x_10          x_15      x_15 (clamped) x_15      x_15        x_15
    full look-ahead    yes       yes           yes       no             no        no          no
    transition known   yes       yes           yes       yes            yes       no (leak)   no (no x_{t+1})

At ``t = T - 2`` the clamped look-ahead *is* ``x_{t+1}``, the prediction target, so this frame never counts. With an
inverse model that reads the successor (``min_offset=1``) it may count.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class StateReader(nn.Module):
    """Reads some columns of states ``[*B, T, d]`` and appends features ``[*B, T, num_features]`` of every state.

    The module ``features`` computes them from ``[*B, T, 1, d]``, for example relative positions. Default: none.
    """

    def __init__(self, columns: Sequence[int], features: nn.Module | None = None):
        super().__init__()
        self.columns, self.features = list(columns), features

    @property
    def width(self) -> int:
        """Number of output columns."""
        return len(self.columns) + (0 if self.features is None else self.features.num_features)

    def forward(self, states: Tensor) -> Tensor:
        """Returns the columns and features of states, ``[*B, T, width]``."""
        read = states[..., self.columns]
        return read if self.features is None else torch.cat([read, self.features(states.unsqueeze(-2))], -1)


class WindowReader(nn.Module):
    r"""Reads the present state and the steps between the frames around it, for every frame of a window.

    With ``num_past = 1`` and ``look_ahead = (2, 5)``, frame ``t = 3`` of a window reads::

        frame       0      1      2      3      4      5      6      7      8
                                  x_2    x_3           x_5                  x_8
        relative          (x_3 - x_2) / s_0, x_3, (x_5 - x_3) / s_2, (x_8 - x_5) / s_3

    Each step is divided by its own spread ``s`` (:meth:`fit`), so that steps of a few millimetres reach a network at
    unit scale. The present frame stays in the normaliser's units.

    Args:
        state_dim (int): size ``d`` of a state.

    Keyword Args:
        num_past (int): number ``n`` of frames before the present one. Defaults to ``4``.
        look_ahead (int or sequence of int): offset ``k``, or several. Defaults to ``(2, 3, 4, 5)``.
        min_offset (int): smallest offset allowed. ``2`` (default) if the successor ``x_{t+1}`` is predicted and must
            not be an input; ``1`` for inverse models that read it.
        relative (bool): read steps, as drawn. ``False``: read the frames themselves. Defaults to ``True``.
        clamped (bool): a frame whose look-ahead is clamped to the window's end counts too, except if it would be
            ``x_{t+1}`` (with ``min_offset=2``) or ``x_t``. Defaults to ``False``.

    Raises:
        ValueError: for a negative ``num_past`` or an offset below ``min_offset``; at a call for states of another size.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import WindowReader
        >>> reader = WindowReader(1, num_past=1, look_ahead=(1, 3), min_offset=1)
        >>> reader(torch.arange(6.0).square()[:, None])[2].tolist()  # 4 - 1, 4, 9 - 4, 25 - 9
        [3.0, 4.0, 5.0, 16.0]
        >>> reader.valid_frames(6)
        range(1, 3)
    """

    scales: Tensor | None

    def __init__(
        self,
        state_dim: int,
        *,
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (2, 3, 4, 5),
        min_offset: int = 2,
        relative: bool = True,
        clamped: bool = False,
    ):
        super().__init__()
        offsets = (look_ahead,) if isinstance(look_ahead, int) else tuple(sorted(look_ahead))
        if num_past < 0:
            raise ValueError(f"num_past must be >= 0 frames, got {num_past}")
        if not offsets or min(offsets) < min_offset:
            why = " (x_(t+1) is never an input)" if min_offset == 2 else ""
            raise ValueError(f"look_ahead offsets must be >= {min_offset}{why}, got {offsets}")
        self.state_dim, self.num_past, self.look_ahead = state_dim, num_past, offsets
        self.min_offset, self.clamped = min_offset, clamped
        self.num_frames = num_past + 1 + len(offsets)
        self.register_buffer("scales", torch.ones(self.num_frames, state_dim) if relative else None)

    @property
    def num_features(self) -> int:
        """Size ``F * d`` of the input of one frame."""
        return self.num_frames * self.state_dim

    @property
    def num_window_frames(self) -> int:
        """Length of the shortest window that holds a frame, its successor and all frames read for it."""
        return self.num_past + 1 + self.look_ahead[-1]

    def valid_frames(self, num_frames: int) -> range:
        """Returns the frames that count in losses: the window holds past, successor and, unless clamped, look-ahead."""
        ahead = self.min_offset if self.clamped else self.look_ahead[-1]
        frames = range(self.num_past, num_frames - ahead)
        if not frames:
            raise ValueError(
                f"a window of {num_frames} frames is too short for {self.num_past} past frames and look-ahead"
                f" {self.look_ahead}: at least {self.num_past + 1 + ahead} frames are needed"
            )
        return frames

    def index(self, num_frames: int, frames: range | None = None, device: torch.device | None = None) -> Tensor:
        """Returns the frames read for each frame, clamped to the window: int64 ``[len(frames), F]``."""
        frames = range(num_frames) if frames is None else frames
        offsets = torch.tensor([*range(-self.num_past, 1), *self.look_ahead], device=device)
        return (torch.arange(frames.start, frames.stop, device=device)[:, None] + offsets).clamp(0, num_frames - 1)

    def gather(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Reads a window of states ``[*B, T, d]`` for all or some of its frames: ``[*B, len(frames), F, d]``.

        Offsets are clamped to the window. Raises a ValueError for another number of columns.
        """
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"expected states with {self.state_dim} columns, got shape {list(state.shape)}")
        read = state[..., self.index(state.shape[-2], frames, state.device), :]  # [*B, T, F, d]
        return read if self.scales is None else self.steps(read) / self.scales

    def steps(self, read: Tensor) -> Tensor:
        """Converts all frames of ``[*B, F, d]`` but the present one to steps between neighbours, not scaled."""
        n, steps = self.num_past, read.diff(dim=-2)
        return torch.cat([steps[..., :n, :], read[..., n : n + 1, :], steps[..., n:, :]], -2)

    def forward(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Reads as :meth:`gather` does, flattened to one row per frame: ``[*B, len(frames), num_features]``."""
        return self.gather(state, frames).flatten(-2)

    @torch.no_grad()
    def fit(self, windows: Tensor) -> None:
        """Sets the spread (root mean square) of every step from windows ``[*B, T, d]``; no label is read."""
        if self.scales is None:
            return
        read = self.gather(windows, self.valid_frames(windows.shape[-2])).flatten(0, -3)
        self.set_spread(read.square().mean(0).sqrt() * self.scales)

    def set_spread(self, spread: Tensor) -> None:
        """Sets the spread ``[F, d]`` that steps are divided by; 1 for steps without spread."""
        self.scales.copy_(torch.where(spread > 1e-9, spread, 1.0))
        self.scales[self.num_past] = 1.0  # the present frame stays in the normaliser's units
