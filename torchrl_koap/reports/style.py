# This source code is licensed under the MIT license found in the LICENSE file.
"""The common style of all pictures: colours, marks, frames; and the check of input arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from torchrl_koap.evaluation.statistics import OUTCOMES as _OUTCOMES

INK, MUTED, FAINT, PALE = "#1f2328", "#6b7280", "#c9ced6", "#f4f5f7"
RED, GREEN, BLUE, ORANGE = "#cf222e", "#1a7f37", "#1f6feb", "#d9730d"
PALE_BLUE, WARNING, GREY = "#9cc3f5", "#9a3412", "#9aa1ab"
TIMEOUT, SUCCESS, COLLISION, ERROR = (_OUTCOMES.index(name) for name in ("timeout", "success", "collision", "error"))
OUTCOMES = {TIMEOUT: "out of time", SUCCESS: "success", COLLISION: "collision", ERROR: "an error of the environment"}
FAILURE_MARKS = {TIMEOUT: "s", COLLISION: "X", ERROR: "v"}


def entry(data: Mapping[str, Any], key: str, shape: Sequence[int | None]) -> np.ndarray:
    """Returns a required entry as an array of the given shape, where None allows any size."""
    if key not in data:
        raise ValueError(f"missing entry {key!r}; got {', '.join(sorted(map(str, data))) or 'nothing'}")
    value = np.asarray(data[key])
    if value.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, value.shape, strict=False)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{key!r} must have shape [{wanted}], got {list(value.shape)}")
    return value


def shorten(name: str, most: int = 18) -> str:
    """Returns a name of at most ``most`` characters; dots replace the middle of a longer one."""
    half = (most - 1) // 2
    return name if len(name) <= most else f"{name[:half]}\N{HORIZONTAL ELLIPSIS}{name[-half:]}"


def with_unit(name: str, unit: str) -> str:
    """Returns a name, with its unit in brackets if it has one."""
    return f"{name} ({unit})" if unit else name


def panels(
    count: int, across: int, size: tuple[float, float], room: tuple[float, float] = (0, 0)
) -> tuple[Figure, list[Axes]]:
    """Returns a figure with panels of a size (inches) in rows of at most ``across``; ``room`` is added around them."""
    across = max(min(count, across), 1)
    down = -(-count // across)
    width, height = size[0] * across + room[0], size[1] * down + room[1]
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, [figure.add_subplot(down, across, index + 1) for index in range(count)]


def tidy(axes: Axes, title: str | None = None, *, grid: bool = False) -> Axes:
    """Styles a panel: light frame, small ticks and labels, optionally a title flush left and horizontal grid lines."""
    if title is not None:
        set_title(axes, title)
    if grid:
        axes.grid(axis="y", color=FAINT, linewidth=0.5)
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
    """Sets the title of a panel, of one or several lines, flush left."""
    axes.set_title(text, loc="left", fontsize=9.5, color=INK, linespacing=1.35)


def put_legend(axes: Axes, *, below: float | None = None, **options: Any) -> None:
    """Puts the legend right of a panel, or ``below`` it by a share of its height; options are of ``Axes.legend``."""
    place = {"loc": "upper left", "bbox_to_anchor": (1.01, 1), "borderaxespad": 0}
    if below is not None:
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, -below), "ncols": 2}
    axes.legend(**({"frameon": False, "fontsize": 8} | place | options))
