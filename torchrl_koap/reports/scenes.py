# This source code is licensed under the MIT license found in the LICENSE file.
"""How what stands still in a task looks from above, and the look that all pictures share.

A new task adds one drawing function to :data:`SCENES`; what moves is in ``plot_objects``, modes in ``mode_names``. The
geometry is repeated here because the environments take seconds to import; a test compares them.
"""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from torchrl_koap.lookup import lookup

INK, MUTED, FAINT = "#1f2328", "#6b7280", "#c9ced6"
RED, GREEN, BLUE = "#cf222e", "#1a7f37", "#1f6feb"

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

# where a context puts the centres of tray and target: x and y range in m (section 6.2)
ALIGNING_REGIONS = (((0.4, 0.6), (-0.25, -0.1)), ((0.4, 0.6), (0.2, 0.35)))

# m (section 6.3); walls of a bin are given from the bin's centre: x, y, half width, half depth
SORTING_PLATFORM = ((0.2, 0.8), (-0.4, 0.2))
SORTING_BINS = ((RED, 0.4, 0.32), (BLUE, 0.625, 0.32))
SORTING_WALLS = ((0, 0.09, 0.1, 0.01), (-0.1, 0, 0.005, 0.1), (0.1, 0, 0.005, 0.1), (0, -0.1, 0.1, 0.005))

STACKING_TARGET, STACKING_RADIUS, STACKING_HALF = (0.5, 0.2), 0.06, 0.05  # m (section 6.4)


def _draw_avoiding(axes: Axes) -> None:
    for x, y, radius in AVOIDING_CYLINDERS:
        axes.add_patch(Circle((x, y), radius + ROD_RADIUS, facecolor="#e9ebee", edgecolor="none", zorder=0.5))
        axes.add_patch(Circle((x, y), radius, facecolor="#7b828d", edgecolor="#565c66", linewidth=0.8, zorder=0.6))
    axes.axhline(AVOIDING_FINISH, color=GREEN, linewidth=1.4, zorder=0.7)
    axes.annotate(
        "finish",
        (1, AVOIDING_FINISH),
        (-3, 2),
        xycoords=("axes fraction", "data"),
        textcoords="offset points",
        ha="right",
        va="bottom",
        color=GREEN,
        fontsize=7.5,
    )
    axes.set_xlim(0.215, 0.785)
    axes.set_ylim(-0.305, 0.405)


def _draw_aligning(axes: Axes) -> None:
    for (left, right), (near, far) in ALIGNING_REGIONS:
        style = {"facecolor": "#f4f5f7", "edgecolor": FAINT, "linewidth": 0.8, "linestyle": "--", "zorder": 0.5}
        axes.add_patch(Rectangle((left, near), right - left, far - near, **style))
    axes.set_xlim(0.21, 0.79)
    axes.set_ylim(-0.39, 0.47)


def _draw_sorting(axes: Axes) -> None:
    (left, right), (near, far) = SORTING_PLATFORM
    axes.add_patch(Rectangle((left, near), right - left, far - near, facecolor="#eef0f3", edgecolor=FAINT, zorder=0.4))
    for color, x, y in SORTING_BINS:
        for across, along, half_width, half_depth in SORTING_WALLS:
            corner = x + across - half_width, y + along - half_depth
            axes.add_patch(Rectangle(corner, 2 * half_width, 2 * half_depth, color=color, alpha=0.45, lw=0, zorder=0.6))
    axes.set_xlim(0.17, 0.83)
    axes.set_ylim(-0.43, 0.45)


def _draw_stacking(axes: Axes) -> None:
    (x, y), half = STACKING_TARGET, STACKING_HALF
    axes.add_patch(Circle((x, y), STACKING_RADIUS, facecolor="#fff3e0", edgecolor="#d9730d", linewidth=0.8, zorder=0.5))
    axes.add_patch(
        Rectangle((x - half, y - half), 2 * half, 2 * half, facecolor="#ffe0b8", edgecolor="none", zorder=0.6)
    )
    axes.text(x, y + STACKING_RADIUS + 0.004, "zone", ha="center", va="bottom", color="#9a5b13", fontsize=7.5)
    axes.set_xlim(0.28, 0.68)
    axes.set_ylim(-0.3, 0.32)


SCENES = {
    "avoiding": _draw_avoiding,
    "aligning": _draw_aligning,
    "sorting": _draw_sorting,
    "sorting_2": _draw_sorting,
    "sorting_6": _draw_sorting,
    "po_sorting": _draw_sorting,
    "stacking": _draw_stacking,
    "stacking_1": _draw_stacking,
}


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
        >>> from torchrl_koap.reports.scenes import draw_scene
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
