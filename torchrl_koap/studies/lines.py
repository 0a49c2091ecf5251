# This source code is licensed under the MIT license found in the LICENSE file.
"""The lines of a curve: colours, markers and dashes of the methods, bands or whiskers, names beside their ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from matplotlib.axes import Axes

from torchrl_koap.reports.style import INK

_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#3a3f47", "#e69f00", "#56b4e9", "#882255", "#7a8b00")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*", "d")
DASHES = ("solid", (0, (5, 1.6)), (0, (1.2, 1.2)))
_BANDS = 3  # more bands than these hide each other: whiskers instead


@dataclass
class Line:
    """A named curve: places, values and their intervals, and how to draw it.

    Args:
        name (str): what stands beside its end.
        x (list of float): places.
        y (list of float): values.
        low (list of float): lower ends of their intervals.
        high (list of float): upper ends.
        paper (list): ``(place, value)`` of the paper, drawn hollow.
        color (str): of line and marker.
        marker (str): of matplotlib.
        dash (optional): of matplotlib.
        end (float): place of its last point, set when it is drawn.

    Examples:
        >>> from torchrl_koap.studies.lines import Line
        >>> Line("koap", x=[1.0], y=[90.0], low=[80.0], high=[95.0]).marker
        'o'
    """

    name: str
    x: list[float] = field(default_factory=list)
    y: list[float] = field(default_factory=list)
    low: list[float] = field(default_factory=list)
    high: list[float] = field(default_factory=list)
    paper: list[tuple[float, float]] = field(default_factory=list)
    color: str = INK
    marker: str = "o"
    dash: Any = "solid"
    end: float = 0.0


def method_styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour, marker and dashes of every method, by its place; no two of the first 27 look alike.

    Examples:
        >>> from torchrl_koap.studies.lines import method_styles
        >>> styles = method_styles([f"method {index}" for index in range(27)])
        >>> len({str(style) for style in styles.values()})
        27
    """
    return {
        method: {
            "color": _COLORS[index % len(_COLORS)],
            "marker": MARKERS[index % len(MARKERS)],
            "dash": DASHES[index // len(_COLORS) % len(DASHES)],
        }
        for index, method in enumerate(methods)
    }


def draw_lines(
    axes: Axes, lines: Sequence[Line], *, beside: Callable[[float, float], float] = lambda x, step: x * 1.014**step
) -> None:
    """Draws lines with bands, or with whiskers where there are many or each has one place alone.

    Args:
        axes (Axes): where to.
        lines (sequence of Line): what to draw; the first lies on top. Each learns where it ends.

    Keyword Args:
        beside (callable): from a place and a number of steps to the place of a whisker that others would hide.
            Defaults to a step on a logarithmic axis.
    """
    whiskers = len(lines) > _BANDS or all(len(line.x) == 1 for line in lines)
    for index, line in enumerate(lines):
        x, order = line.x, 3 + (len(lines) - index) / 100  # the first method lies on top
        if whiskers:  # beside each other
            x = [beside(value, index - (len(lines) - 1) / 2) for value in x]
            axes.vlines(x, line.low, line.high, color=line.color, linewidth=0.9, alpha=0.55, zorder=order - 1)
        else:
            axes.fill_between(x, line.low, line.high, color=line.color, alpha=0.13, linewidth=0, zorder=order - 1)
            if len(x) == 1:  # a band needs two places
                axes.vlines(x, line.low, line.high, color=line.color, linewidth=2.5, alpha=0.3, zorder=order - 1)
        line.end = x[-1]
        style = {"color": line.color, "marker": line.marker, "markersize": 5}
        axes.plot(x, line.y, linestyle=line.dash, linewidth=1.6, markeredgewidth=0, zorder=order, **style)
        if line.paper:
            px, py = zip(*sorted(line.paper), strict=True)
            style |= {"markersize": 6.5, "markerfacecolor": "white", "markeredgewidth": 1.3}
            axes.plot(px, py, linestyle=(0, (2, 2)), linewidth=1, zorder=order + 0.5, **style)


def name_lines(axes: Axes, lines: Sequence[Line]) -> None:
    """Names to the right of the panel at the height of the lines' ends, moved apart, joined to them by thin lines.

    Args:
        axes (Axes): a panel that is drawn and has its limits.
        lines (sequence of Line): the lines.
    """
    axes.figure.canvas.draw()  # the height of the panel is known only when it was laid out
    step = 11.5 * axes.figure.dpi / 72 / max(axes.get_window_extent().height, 1)
    heights = [axes.transAxes.inverted().transform(axes.transData.transform((line.end, line.y[-1]))) for line in lines]
    order = sorted(range(len(lines)), key=lambda index: (round(heights[index][1], 6), -index))
    places = _spread([float(heights[index][1]) for index in order], step)
    for index, place in zip(order, places, strict=True):
        line, (x, y) = lines[index], heights[index]
        kwargs = {"transform": axes.transAxes, "clip_on": False, "color": line.color}
        style = "solid" if x > 0.85 else (0, (1, 4))  # far from the name it must not look like data
        axes.plot([x, 1.015, 1.055], [y, y, place], linestyle=style, linewidth=0.6, alpha=0.6, **kwargs)
        axes.plot([1.085], [place], marker=line.marker, markersize=5, markeredgewidth=0, **kwargs)
        axes.text(1.115, place, line.name, transform=axes.transAxes, va="center", fontsize=8.5, color=INK)


def _spread(wanted: Sequence[float], step: float) -> list[float]:
    """Places in 0..1, at least ``step`` apart, for ascending wanted ones.

    Places that would be too close form a block around the mean of what they want; blocks that meet are joined.
    """
    blocks: list[list[float]] = []
    for value in wanted:
        blocks.append([value])
        while len(blocks) > 1:
            left, right = blocks[-2], blocks[-1]
            reach = step * (len(left) + len(right)) / 2
            if sum(right) / len(right) - sum(left) / len(left) >= reach:
                break
            blocks[-2:] = [left + right]
    places = [
        sum(block) / len(block) + step * (index - (len(block) - 1) / 2)
        for block in blocks
        for index in range(len(block))
    ]
    last = len(places) - 1
    return [min(max(place, step * index), 1 - step * (last - index)) for index, place in enumerate(places)]
