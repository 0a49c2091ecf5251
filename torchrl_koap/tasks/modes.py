# This source code is licensed under the MIT license found in the LICENSE file.
"""A name and a colour for every mode of a task; a new task adds one line to :data:`CHOICES`."""

from __future__ import annotations

import itertools
import math

import numpy as np


def _arrivals(each: int) -> tuple[str, ...]:
    """Every order in which so many red and as many blue boxes can arrive, red before blue."""
    orders = sorted(set(itertools.permutations((0,) * each + (1,) * each)))
    return tuple(", ".join(("red", "blue")[color] for color in order) for order in orders)


_BOXES = ("red", "green", "blue")
_ORDERS = tuple(", ".join(order) for order in itertools.permutations(_BOXES))
# the choices a mode is made of, slowest digit first, each with the names of its values
CHOICES = {
    "avoiding": (
        ("row 1", ("left", "right")),
        ("row 2", ("left", "middle", "right")),
        ("row 3", ("gap 1", "gap 2", "gap 3", "gap 4")),
    ),
    "aligning": (("pushed from", ("inside", "outside")),),
    "sorting": (("order of arrival", _arrivals(2)),),
    "sorting_2": (("order of arrival", _arrivals(1)),),
    "sorting_6": (("order of arrival", _arrivals(3)),),
    "po_sorting": (("order of arrival", _arrivals(2)),),
    "stacking": (("order of arrival", _ORDERS),),
    "stacking_1": (("first box", _BOXES),),
}


def mode_choices(task: str | None, num_modes: int | None = None) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Choices that make up a mode, the slowest digit first; a single one where the task names none.

    Args:
        task (str, optional): name of the task.
        num_modes (int, optional): number of modes, needed for a task without an entry in ``CHOICES``.

    Raises:
        ValueError: if the task has no entry and ``num_modes`` is not given.
    """
    if task in CHOICES:
        return CHOICES[task]
    if num_modes is None:
        raise ValueError(f"the modes of task {task!r} are not in CHOICES; wanted num_modes")
    return (("mode", tuple(str(index) for index in range(num_modes))),)


def mode_colors(task: str | None, num_modes: int | None = None) -> np.ndarray:
    """A colour for each mode: hue tells the last choice apart, lightness all choices before it.

    Hues and lightness are even steps of OKLCH, a space in which equal steps look equal.

    Args:
        task (str, optional): name of the task.
        num_modes (int, optional): number of modes, needed for a task without an entry in ``CHOICES``.

    Returns:
        np.ndarray: sRGB colours in 0..1 [num_modes, 3].

    Examples:
        >>> from torchrl_koap.tasks.modes import mode_colors
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


def mode_name(mode: int, task: str | None, num_modes: int | None = None) -> str:
    """A mode in words.

    Examples:
        >>> from torchrl_koap.tasks.modes import mode_name
        >>> mode_name(23, "avoiding"), mode_name(1, "sorting"), mode_name(-1, "avoiding")
        ('right, right, gap 4', 'red, blue, red, blue', 'no mode')
    """
    choices = mode_choices(task, num_modes)
    if not 0 <= mode < math.prod(len(names) for _, names in choices):
        return "no mode"
    words = []
    for _, names in reversed(choices):
        mode, digit = divmod(mode, len(names))
        words.append(names[digit])
    return ", ".join(reversed(words))


def initials(name: str) -> str:
    """A name that lists several things, by their first letters; other names as they are.

    Examples:
        >>> from torchrl_koap.tasks.modes import initials
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
            return tuple(
                12.92 * max(v, 0) if v <= 0.0031308 else 1.055 * min(v, 1) ** (1 / 2.4) - 0.055 for v in linear
            )
        chroma *= 0.97
