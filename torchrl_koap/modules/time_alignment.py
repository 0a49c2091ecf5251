# This source code is licensed under the MIT license found in the LICENSE file.
"""Which frames of a window a controller reads for each frame, which count in a loss, and the gatherer that reads them.

With ``num_past = 1`` frame before the present one, look-ahead ``k = 8`` and a window of ``T = 16`` frames::

    frame t            1         2        ...  7         8         ...  13        14          15
    f reads            x_0,x_1   x_1,x_2       x_6,x_7   x_7,x_8        x_12,x_13 x_13,x_14   x_14,x_15
    and x_{t+k}        x_9       x_10          x_15      x_15 (clamped) x_15      x_15        x_15
    full look-ahead    yes       yes           yes       no             no        no          no
    transition known   yes       yes           yes       yes            yes       no (leak)   no (no x_{t+1})

At ``t = T - 2`` the clamped look-ahead *is* ``x_{t+1}``, the answer: such a frame never counts. An inverse model that
is *given* the successor (``least=1``) may count it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


def check_offsets(num_past: int, look_ahead: int | Sequence[int], *, least: int = 2) -> tuple[int, ...]:
    """Validates and returns the look-ahead offsets, ascending.

    Args:
        num_past (int): frames read before the present one.
        look_ahead (int or sequence of int): offset ``k``, or several.

    Keyword Args:
        least (int): smallest offset allowed: ``2`` (default) where ``x_{t+1}`` is what the latent action must explain,
            ``1`` where it may be read.

    Raises:
        ValueError: if ``num_past < 0``, or an offset is below ``least``.

    Examples:
        >>> from torchrl_koap.modules.time_alignment import check_offsets
        >>> check_offsets(1, (8, 2))
        (2, 8)
    """
    offsets = (look_ahead,) if isinstance(look_ahead, int) else tuple(sorted(look_ahead))
    if num_past < 0:
        raise ValueError(f"num_past must be >= 0 frames, got {num_past}")
    if not offsets or min(offsets) < least:
        why = " (x_(t+1) is never an input)" if least == 2 else ""
        raise ValueError(f"look_ahead offsets must be >= {least}{why}, got {offsets}")
    return offsets


def frame_span(
    num_frames: int, num_past: int, look_ahead: int | Sequence[int], *, clamped: bool = False, least: int = 2
) -> range:
    """Frames that count in the losses: past, successor and look-ahead lie in the window.

    Args:
        num_frames (int): frames ``T`` of the window.
        num_past (int): frames read before the present one.
        look_ahead (int or sequence of int): offset ``k``, or several.

    Keyword Args:
        clamped (bool): a look-ahead cut at the window's end counts too, except where it would be ``x_{t+1}`` (with
            ``least=2``) or ``x_t``.
        least (int): as for :func:`check_offsets`.

    Raises:
        ValueError: if no frame of so short a window counts.

    Examples:
        >>> from torchrl_koap.modules.time_alignment import frame_span
        >>> frame_span(16, 1, 8), frame_span(16, 1, 8, clamped=True), frame_span(16, 1, 1, least=1)
        (range(1, 8), range(1, 14), range(1, 15))
    """
    offsets = check_offsets(num_past, look_ahead, least=least)
    ahead = least if clamped else offsets[-1]
    span = range(num_past, num_frames - ahead)
    if not span:
        raise ValueError(
            f"a window of {num_frames} frames is too short for {num_past} past frames and look-ahead {offsets}:"
            f" at least {num_past + 1 + ahead} frames are needed"
        )
    return span


def frame_index(frames: range, num_frames: int, num_past: int, look_ahead: int | Sequence[int], device=None) -> Tensor:
    """Frames read for each of ``frames``, clamped to the window: ``[len(frames), num_past + 1 + len(k)]``.

    Args:
        frames (range): frames to read for.
        num_frames (int): frames ``T`` of the window.
        num_past (int): frames read before the present one.
        look_ahead (int or sequence of int): offset ``k``, or several.
        device (optional): of the index.

    Examples:
        >>> from torchrl_koap.modules.time_alignment import frame_index
        >>> frame_index(range(16), 16, 1, 8)[[1, 7, 14]].tolist()
        [[0, 1, 9], [6, 7, 15], [13, 14, 15]]
    """
    offsets = [*range(-num_past, 1), *check_offsets(num_past, look_ahead, least=1)]
    rows = torch.arange(frames.start, frames.stop, device=device)[:, None]
    return (rows + torch.tensor(offsets, device=device)).clamp(0, num_frames - 1)


class FrameGatherer(nn.Module):
    r"""Gathers what a controller reads for a frame: the present state and the steps between the frames around it.

    With ``num_past = 1`` and ``look_ahead = (2, 5)``, frame ``t = 3`` of a window reads::

        frame       0      1      2      3      4      5      6      7      8
                                  x_2    x_3           x_5                  x_8
        relative          (x_3 - x_2) / s_0, x_3, (x_5 - x_3) / s_2, (x_8 - x_5) / s_3

    Each step is divided by its own spread ``s`` (:meth:`fit_scales`): steps of a few millimetres then reach a network
    at unit scale, not as differences of numbers of order one, and a decoder that weighs them all alike is a local mean
    velocity. The present frame stays in the normaliser's units.

    Args:
        state_dim (int): size ``d`` of a state.

    Keyword Args:
        num_past (int): number ``n`` of frames before the present one. Defaults to ``4``.
        look_ahead (int or sequence of int): offset ``k``, or several. Defaults to ``(2, 3, 4, 5)``.
        least (int): smallest offset allowed. ``2`` (default) where the successor ``x_{t+1}`` is to be predicted and so
            never an input; ``1`` for inverse models that are given it.
        relative (bool): read steps, as drawn. ``False``: the frames themselves. Defaults to ``True``.
        clamped (bool): frames whose look-ahead is cut at the window's end count in the losses (:func:`frame_span`).

    Raises:
        ValueError: for a negative ``num_past`` or an offset below ``least``; at the call for states of another size.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.time_alignment import FrameGatherer
        >>> reader = FrameGatherer(1, num_past=1, look_ahead=(1, 3), least=1)
        >>> reader(torch.arange(6.0).square()[:, None])[2].tolist()  # 4 - 1, 4, 9 - 4, 25 - 9
        [3.0, 4.0, 5.0, 16.0]
        >>> reader.span(6)
        range(1, 3)
    """

    scales: Tensor

    def __init__(
        self,
        state_dim: int,
        *,
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (2, 3, 4, 5),
        least: int = 2,
        relative: bool = True,
        clamped: bool = False,
    ):
        super().__init__()
        self.state_dim, self.num_past, self.least = state_dim, num_past, least
        self.look_ahead = check_offsets(num_past, look_ahead, least=least)
        self.relative, self.clamped = relative, clamped
        self.num_frames = num_past + 1 + len(self.look_ahead)
        self.register_buffer("scales", torch.ones(self.num_frames, state_dim))

    @property
    def num_features(self) -> int:
        """Size ``F * d`` of what is read for one frame."""
        return self.num_frames * self.state_dim

    @property
    def num_window_frames(self) -> int:
        """Frames of the shortest window in which a frame (number ``num_past``) has all it reads and its successor."""
        return self.num_past + 1 + self.look_ahead[-1]

    def span(self, num_frames: int) -> range:
        """Frames of a window of ``num_frames`` that count in the losses.

        Raises:
            ValueError: if the window is too short to hold one.
        """
        return frame_span(num_frames, self.num_past, self.look_ahead, clamped=self.clamped, least=self.least)

    def gather(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What every frame of a window, or some of its ``frames``, reads.

        Args:
            state (Tensor): states ``[*B, T, d]`` in the networks' units.
            frames (range, optional): frames to read for. Default: all; offsets beyond the window are clamped to it.

        Returns:
            Tensor: ``[*B, len(frames), F, d]`` with ``F = num_past + 1 + len(look_ahead)``.

        Raises:
            ValueError: if the states have another number of columns.
        """
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"expected states with {self.state_dim} columns, got shape {list(state.shape)}")
        num_frames, n = state.shape[-2], self.num_past
        frames = range(num_frames) if frames is None else frames
        read = state[..., frame_index(frames, num_frames, n, self.look_ahead, state.device), :]  # [*B, T, F, d]
        if not self.relative:
            return read
        steps = read[..., 1:, :] - read[..., :-1, :]
        return torch.cat([steps[..., :n, :], read[..., n : n + 1, :], steps[..., n:, :]], -2) / self.scales

    def forward(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What every frame reads, side by side: :meth:`gather` in one row per frame.

        Args:
            state (Tensor): states ``[*B, T, d]`` in the networks' units.
            frames (range, optional): frames to read for. Default: all.

        Returns:
            Tensor: ``[*B, len(frames), num_features]``.

        Raises:
            ValueError: if the states have another number of columns.
        """
        return self.gather(state, frames).flatten(-2)

    @torch.no_grad()
    def fit_scales(self, windows: Tensor) -> None:
        """Sets the spread (root mean square) of every step from windows ``[*B, T, d]``; no label is read."""
        if not self.relative:
            return
        read = self.gather(windows, self.span(windows.shape[-2])).flatten(0, -3)
        spread = read.square().mean(0).sqrt() * self.scales
        spread[self.num_past] = 1.0  # the present frame stays in the normaliser's units
        self.scales.copy_(torch.where(spread > 1e-9, spread, torch.ones_like(spread)))
