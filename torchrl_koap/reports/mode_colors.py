# This source code is licensed under the MIT license found in the LICENSE file.
"""A colour and a short name for every mode of a task."""

from __future__ import annotations

import math

import numpy as np

from torchrl_koap.tasks.modes import mode_choices


def mode_colors(task: str | None, num_modes: int | None = None) -> np.ndarray:
    """A colour for each mode: hue tells the last choice apart, lightness all choices before it.

    Hues and lightness are even steps of OKLCH, a space in which equal steps look equal.

    Args:
        task (str, optional): name of the task.
        num_modes (int, optional): number of modes, needed for a task without choices.

    Returns:
        np.ndarray: sRGB colours in 0..1 [num_modes, 3].

    Examples:
        >>> from torchrl_koap.reports.mode_colors import mode_colors
        >>> mode_colors("avoiding").shape
        (24, 3)
    """
    counts = [len(names) for _, names in mode_choices(task, num_modes)]
    hues, shades = counts[-1], math.prod(counts[:-1])
    step = min(98.0, 360.0 / max(hues, 1))
    even = 0.58, 0.58 if hues <= 8 else 0.74  # neighbours among many hues need another lightness too
    colors = [
        _oklch(0.40 + 0.36 * shade / (shades - 1) if shades > 1 else even[hue % 2], 0.155, 255.0 - step * hue)
        for shade in range(shades)
        for hue in range(hues)
    ]
    return np.array(colors)


def initials(name: str) -> str:
    """A name that lists several things, by their first letters; other names as they are.

    Examples:
        >>> from torchrl_koap.reports.mode_colors import initials
        >>> initials("red, blue, red, blue"), initials("outside")
        ('r b r b', 'outside')
    """
    return " ".join(word[0] for word in name.split(", ")) if ", " in name else name


def _oklch(lightness: float, chroma: float, hue: float) -> tuple[float, float, float]:
    """Colour of OKLCH (hue in degrees) in sRGB; chroma is lowered until the colour exists there."""
    while True:
        a, b = chroma * math.cos(math.radians(hue)), chroma * math.sin(math.radians(hue))
        long = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3
        medium = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3
        short = (lightness - 0.0894841775 * a - 1.2914855480 * b) ** 3
        linear = (
            4.0767416621 * long - 3.3077115913 * medium + 0.2309699292 * short,
            -1.2684380046 * long + 2.6097574011 * medium - 0.3413193965 * short,
            -0.0041960863 * long - 0.7034186147 * medium + 1.7076147010 * short,
        )
        if min(linear) >= -1e-6 and max(linear) <= 1 + 1e-6:
            red, green, blue = (
                12.92 * max(v, 0) if v <= 0.0031308 else 1.055 * min(v, 1) ** (1 / 2.4) - 0.055 for v in linear
            )
            return red, green, blue
        chroma *= 0.97
