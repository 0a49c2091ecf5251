# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes figures and films aside first, so that an earlier picture is replaced whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from torchrl_koap.files import replacing_file

HOLD_SECONDS = 1.5  # of the last frame of a film


@dataclass(frozen=True)
class Film:
    """A moving picture.

    Args:
        frames (iterable): images ``[height, width, 3]``, uint8, of equal size.
        seconds (float): how long each is shown; the last one is held for longer.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.reports.writing import Film
        >>> len(list(Film([np.zeros((30, 40, 3), np.uint8)] * 3, 0.07).frames))
        3
    """

    frames: Iterable[np.ndarray]
    seconds: float


def save_figure(figure: Figure, path: str | Path) -> Path:
    """Writes a figure as png and returns the file."""
    path = Path(path)
    with replacing_file(path) as aside:
        figure.savefig(aside, format="png", dpi=150, facecolor="white", metadata={"Software": None})
    return path


def save_film(film: Film, path: str | Path) -> Path:
    """Writes a film as gif and returns the file."""
    path, frames = Path(path), list(film.frames)
    with replacing_file(path) as aside:
        # one palette for all, without dithering: what stands still does not flicker and costs nothing
        some = Image.fromarray(np.concatenate([frames[0], frames[len(frames) // 2], frames[-1]]))
        palette = some.quantize(224, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)  # keeps rare colours
        images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
        times = [round(1000 * film.seconds)] * (len(images) - 1) + [round(1000 * HOLD_SECONDS)]
        images[0].save(aside, "GIF", save_all=True, append_images=images[1:], duration=times, loop=0)
    return path
