# This source code is licensed under the MIT license found in the LICENSE file.
"""Which frames of a window the latent action of each frame may look at, and which frames count in a loss.

With history ``n = 1``, look-ahead ``k = 8`` and a window of ``T = 16`` frames (design section 3)::

    frame t            1         2        ...  7         8         ...  13        14          15
    f reads            x_0,x_1   x_1,x_2       x_6,x_7   x_7,x_8        x_12,x_13 x_13,x_14   x_14,x_15
    and x_{t+k}        x_9       x_10          x_15      x_15 (clamped) x_15      x_15        x_15
    full look-ahead    yes       yes           yes       no             no        no          no
    transition known   yes       yes           yes       yes            yes       no (leak)   no (no x_{t+1})

At ``t = T - 2`` the clamped look-ahead *is* ``x_{t+1}``, the answer: such a frame never counts.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def check_offsets(history: int, look_ahead: int | Sequence[int], *, least: int = 2) -> tuple[int, ...]:
    """Validates and returns the look-ahead offsets, ascending.

    Raises:
        ValueError: if ``history < 0``, or an offset is below ``least``, by default 2 (``x_{t+1}`` is what the latent
            action must explain).
    """
    offsets = (look_ahead,) if isinstance(look_ahead, int) else tuple(sorted(look_ahead))
    if history < 0:
        raise ValueError(f"history must be >= 0 frames, got {history}")
    if not offsets or min(offsets) < least:
        why = " (x_(t+1) is never an input)" if least == 2 else ""
        raise ValueError(f"look_ahead offsets must be >= {least}{why}, got {offsets}")
    return offsets


def frame_span(num_frames: int, history: int, look_ahead: int | Sequence[int], *, clamped: bool = False) -> range:
    """Frames that count in the losses: history, successor and look-ahead lie in the window.

    With ``clamped=True`` a look-ahead cut at the window's end counts too, except where it would be ``x_{t+1}``.

    Raises:
        ValueError: if no frame of so short a window counts.

    Examples:
        >>> from torchrl_koap.modules.time_alignment import frame_span
        >>> frame_span(16, 1, 8), frame_span(16, 1, 8, clamped=True)
        (range(1, 8), range(1, 14))
    """
    offsets = check_offsets(history, look_ahead)
    span = range(history, num_frames - (2 if clamped else offsets[-1]))
    if not span:
        needed = history + 1 + (2 if clamped else offsets[-1])
        raise ValueError(
            f"a window of {num_frames} frames is too short for history {history} and look-ahead {offsets}:"
            f" at least {needed} frames are needed"
        )
    return span


def frame_index(frames: range, num_frames: int, history: int, look_ahead: int | Sequence[int], device=None) -> Tensor:
    """Frames read by ``f`` for each of ``frames``, clamped to the window: ``[len(frames), history + 1 + len(k)]``.

    Examples:
        >>> from torchrl_koap.modules.time_alignment import frame_index
        >>> frame_index(range(16), 16, 1, 8)[[1, 7, 14]].tolist()
        [[0, 1, 9], [6, 7, 15], [13, 14, 15]]
    """
    offsets = [*range(-history, 1), *check_offsets(history, look_ahead, least=1)]
    rows = torch.arange(frames.start, frames.stop, device=device)[:, None]
    return (rows + torch.tensor(offsets, device=device)).clamp(0, num_frames - 1)
