# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws what stands still in a task, from above (:class:`~torchrl_koap.tasks.Scene`)."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from torchrl_koap.lookup import lookup
from torchrl_koap.reports.style import BLUE, FAINT, GREEN, MUTED, RED, tidy
from torchrl_koap.tasks import Shape, get_task

_NAMED = {"red": RED, "green": GREEN, "blue": BLUE, "grey": MUTED}
# how a role is drawn; a shape's own colour goes before the role's
ROLES = {
    "clearance": {"facecolor": "#e9ebee", "edgecolor": "none", "zorder": 0.5},
    "obstacle": {"facecolor": "#7b828d", "edgecolor": "#565c66", "linewidth": 0.8, "zorder": 0.6},
    "finish": {"color": GREEN, "linewidth": 1.4, "zorder": 0.7},
    "region": {"facecolor": "#f4f5f7", "edgecolor": FAINT, "linewidth": 0.8, "linestyle": "--", "zorder": 0.5},
    "platform": {"facecolor": "#eef0f3", "edgecolor": FAINT, "zorder": 0.4},
    "wall": {"color": MUTED, "alpha": 0.45, "linewidth": 0, "zorder": 0.6},
    "zone": {"facecolor": "#fff3e0", "edgecolor": "#d9730d", "linewidth": 0.8, "zorder": 0.5},
    "target": {"facecolor": "#ffe0b8", "edgecolor": "none", "zorder": 0.6},
}
_LABEL_COLORS = {"finish": GREEN, "zone": "#9a5b13"}


def color_of(name: str) -> str:
    """The colour that pictures use for a name such as ``"red"``; others, such as ``"#9a5b13"``, as they are."""
    return _NAMED.get(name, name)


def _draw_shape(axes: Axes, shape: Shape) -> None:
    style = dict(lookup(ROLES, shape.role, "role of a shape"))
    if shape.color is not None:
        style["color" if "color" in style else "facecolor"] = color_of(shape.color)
    (x, y), (width, depth) = shape.center, shape.half
    if shape.kind == "circle":
        axes.add_patch(Circle((x, y), width, **style))
    elif shape.kind == "rectangle":
        axes.add_patch(Rectangle((x - width, y - depth), 2 * width, 2 * depth, **style))
    else:
        axes.plot([x - width, x + width], [y - depth, y + depth], **style)
    if shape.label:
        word = {"color": _LABEL_COLORS.get(shape.role, MUTED), "fontsize": 7.5, "va": "bottom"}
        if shape.kind == "line":
            place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
            axes.annotate(shape.label, (1, y), (-3, 2), ha="right", **place, **word)
        else:
            axes.text(x, y + depth + 0.004, shape.label, ha="center", **word)


def draw_scene(axes: Axes, task: str | None) -> Axes:
    """Draws what stands still in a task, to scale and from above, and labels the axes in metres.

    Args:
        axes (Axes): where to draw.
        task (str, optional): name of the task. None draws the axes only.

    Returns:
        Axes: the same axes.

    Raises:
        ValueError: if the task is unknown; the message suggests the nearest name.

    Examples:
        >>> from matplotlib.figure import Figure
        >>> from torchrl_koap.reports.scenes import draw_scene
        >>> axes = draw_scene(Figure().add_subplot(), "avoiding")
        >>> len(axes.patches)  # six cylinders, each with a ring where the rod touches it
        12
    """
    if task is not None:
        scene = get_task(task).scene
        for shape in scene.shapes:
            _draw_shape(axes, shape)
        if scene.x is not None:
            axes.set_xlim(*scene.x)
        if scene.y is not None:
            axes.set_ylim(*scene.y)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    tidy(axes)
    return axes
