# This source code is licensed under the MIT license found in the LICENSE file.
"""How a task looks from above, and a colour and a name for each of its modes.

A new task adds one drawing function to :data:`SCENES` and, if its modes are made of several choices, one line to
:data:`CHOICES`. The geometry is repeated here because the environments take seconds to import; a test compares them.
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from torchrl_koap.lookup import lookup

INK, MUTED, FAINT = "#1f2328", "#6b7280", "#c9ced6"

# x, y, radius in m (specification, section 6.1)
AVOIDING_CYLINDERS = (
    (0.5, -0.1, 0.03),
    (0.425, 0.08, 0.025),
    (0.575, 0.08, 0.025),
    (0.35, 0.26, 0.025),
    (0.5, 0.26, 0.025),
    (0.65, 0.26, 0.025),
)
AVOIDING_FINISH = 0.35
ROD_RADIUS = 0.01

# the choices a mode is made of, slowest digit first, each with the names of its values
CHOICES = {
    "avoiding": (
        ("row 1", ("left", "right")),
        ("row 2", ("left", "middle", "right")),
        ("row 3", ("gap 1", "gap 2", "gap 3", "gap 4")),
    ),
}


def _draw_avoiding(axes: Axes) -> None:
    for x, y, radius in AVOIDING_CYLINDERS:
        axes.add_patch(Circle((x, y), radius + ROD_RADIUS, facecolor="#e9ebee", edgecolor="none", zorder=0.5))
        axes.add_patch(Circle((x, y), radius, facecolor="#7b828d", edgecolor="#565c66", linewidth=0.8, zorder=0.6))
    axes.axhline(AVOIDING_FINISH, color="#1a7f37", linewidth=1.4, zorder=0.7)
    axes.annotate(
        "finish",
        (1, AVOIDING_FINISH),
        (-3, 2),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha="right",
        va="bottom",
        color="#1a7f37",
        fontsize=7.5,
    )
    axes.set_xlim(0.215, 0.785)
    axes.set_ylim(-0.305, 0.405)


SCENES = {"avoiding": _draw_avoiding}


def draw_scene(axes: Axes, task: str | None) -> Axes:
    """Draws what stands still in a task, to scale and from above, and labels the axes in metres.

    Args:
        axes (Axes): where to draw.
        task (str, optional): name of the task. None draws the axes only.

    Returns:
        Axes: the same axes.

    Raises:
        ValueError: if no drawing is known for the task; the message suggests the nearest name.

    Examples:
        >>> from matplotlib.figure import Figure
        >>> from torchrl_koap.plot_scenes import draw_scene
        >>> axes = draw_scene(Figure().add_subplot(), "avoiding")
        >>> len(axes.patches)  # six cylinders, each with a ring where the rod touches it
        12
    """
    if task is not None:
        lookup(SCENES, task, "scene")(axes)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    tidy(axes)
    return axes


def tidy(axes: Axes) -> Axes:
    """Light frame, small ticks and labels: the look that all pictures share."""
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(FAINT)
    axes.tick_params(which="both", color=FAINT, labelsize=8, labelcolor=MUTED)
    for label in (axes.xaxis.label, axes.yaxis.label):
        label.set_size(9)
        label.set_color(INK)
    return axes


def set_title(axes: Axes, text: str) -> None:
    """Title of a panel, flush left."""
    axes.set_title(text, loc="left", fontsize=9.5, color=INK, linespacing=1.35)


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
        >>> from torchrl_koap.plot_scenes import mode_colors
        >>> mode_colors("avoiding").shape
        (24, 3)
    """
    counts = [len(names) for _, names in mode_choices(task, num_modes)]
    hues, shades = counts[-1], math.prod(counts[:-1])
    step = min(98.0, 360.0 / max(hues, 1))
    colors = [
        _oklch(0.40 + 0.36 * shade / max(shades - 1, 1) if shades > 1 else 0.58, 0.155, 255.0 - step * hue)
        for shade in range(shades)
        for hue in range(hues)
    ]
    return np.array(colors)


def mode_name(mode: int, task: str | None, num_modes: int | None = None) -> str:
    """A mode in words.

    Examples:
        >>> from torchrl_koap.plot_scenes import mode_name
        >>> mode_name(23, "avoiding"), mode_name(-1, "avoiding")
        ('right, right, gap 4', 'no mode')
    """
    choices = mode_choices(task, num_modes)
    if not 0 <= mode < math.prod(len(names) for _, names in choices):
        return "no mode"
    words = []
    for _, names in reversed(choices):
        mode, digit = divmod(mode, len(names))
        words.append(names[digit])
    return ", ".join(reversed(words))


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
