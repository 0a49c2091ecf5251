# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures of a study: a measure against the labels, a line per method; success averaged over tasks.

Colours are safe for colour-blind readers; markers and dashes distinguish the lines without colour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator
from matplotlib.transforms import ScaledTranslation

from torchrl_koap.reports.pictures import save_figure
from torchrl_koap.reports.style import INK, set_title, tidy, with_unit
from torchrl_koap.studies.table import Summary, percent

AXES = {
    "labels": "labelled share",
    "labelled_transitions": "distinct labelled transitions",
    "demonstrations": "demonstrations used, share of all",
}
_SEEDS = "mean over seeds, from best to worst seed"
MEASURES = {  # label of the vertical axis, title, factor
    "success": ("success (%)", "success, 95 % interval", 100),
    "mode_entropy": ("entropy of the modes", _SEEDS, 1),
    "action_error": ("action error", _SEEDS, 1),
    "relative_action_error": ("action error, share of the mean action's", _SEEDS, 1),
}
_COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#3a3f47", "#e69f00", "#56b4e9", "#882255", "#7a8b00")
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "p", "h", "*", "d")
_DASHES = ("solid", (0, (5, 1.6)), (0, (1.2, 1.2)))
Average = tuple[int, float, float, float, float | None]
"""Label level, mean success in 0..1 with the ends of its 95 % interval, and the paper's mean, if it has one."""
_HOLLOW = "\nhollow, dashed: the paper, with its own demonstrations"  # in titles
_BANDS = 3  # more lines have whiskers, as more bands hide each other
_ASIDE = 0.025  # inches between the whiskers of two methods


@dataclass
class _Line:
    """A named line of points ``(x, y, low, high)``, the paper's points ``(x, y)``, and its style."""

    name: str
    style: Mapping[str, Any]
    points: list[tuple[float, ...]] = field(default_factory=list)
    paper: Sequence[tuple[float, float]] = ()

    @property
    def positions(self) -> list[float]:
        return [x for x, *_ in self.points]


def method_styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Returns colour, marker and linestyle of every method, by its place; the first 27 all differ."""
    return {
        method: {
            "color": _COLORS[index % len(_COLORS)],
            "marker": _MARKERS[index % len(_MARKERS)],
            "linestyle": _DASHES[index // len(_COLORS) % len(_DASHES)],
        }
        for index, method in enumerate(methods)
    }


def plot_measure(
    summaries: Sequence[Summary],
    path: str | Path,
    measure: str = "success",
    *,
    by: Sequence[str] = ("labels",),
    paper: Mapping[str, Sequence[tuple[float, float]]] | None = None,
    methods: Sequence[str] | None = None,
    unit: str = "",
    label_unit: str = "",
) -> None:
    """Draws a measure of every method with its ends, a panel per entry of ``by``.

    The measure is one of :data:`MEASURES`, in ``unit``; the horizontal axes are of :data:`AXES`, labels counted in
    ``label_unit``. The panel ``"demonstrations"`` has a line per method and share of labels that was run with several
    shares of demonstrations. ``paper`` has label shares and successes by method, drawn hollow and dashed in the panel
    ``"labels"``. ``methods`` are all methods, in the order of their colours.
    """
    head, title, factor = MEASURES[measure]
    panels = {name: _lines(summaries, name, measure, factor, methods) for name in by}
    panels = {name: lines for name, lines in panels.items() if lines}
    for line in panels.get("labels", ()) if paper else ():
        line.paper = [(share, 100 * success) for share, success in paper.get(line.name, ())]
    title += _HOLLOW if paper else ""
    figure = Figure(figsize=(1.9 + 4.1 * len(panels), 4.1), layout="constrained")
    for place, (axes, (name, lines)) in enumerate(
        zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True)
    ):
        _draw_lines(axes, lines)
        axes.set_xlabel(with_unit(AXES[name], label_unit if name == "labels" else ""))
        _log_x(axes, lines, ticks=name != "labelled_transitions")
        if place == 0:
            axes.set_ylabel(with_unit(head, unit))
        set_title(axes, title if place == 0 else "")
        if measure.endswith("error"):
            _scale_errors(axes, lines)
            if measure == "relative_action_error":  # 1: a controller that always gives the mean action
                axes.axhline(1, color=INK, linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
        else:
            _scale_shares(axes, 100 if measure == "success" else 1)
        tidy(axes, grid=True)
    _name_lines(figure, [line for lines in panels.values() for line in lines])
    save_figure(figure, path)


def plot_average(averages: Mapping[str, Sequence[Average]], number: int, path: str | Path) -> None:
    """Draws success by method, averaged over a ``number`` of tasks, against the label level; the paper's is hollow."""
    lines, styles = [], method_styles(list(averages))
    for method, points in averages.items():
        shown = [(level, *(100 * value for value in values)) for level, *values, _ in points]
        beside = [(level, 100 * mean) for level, *_, mean in points if mean is not None]
        lines.append(_Line(method, styles[method], shown, beside))
    figure = Figure(figsize=(7.4, 4.6), layout="constrained")
    axes = figure.add_subplot()
    _draw_lines(axes, lines)
    levels = sorted({level for line in lines for level in line.positions})
    axes.set(xlim=(levels[0] - 0.25, levels[-1] + 0.25), xticks=levels)
    axes.set(xlabel="label level (1: fewest labels)", ylabel="success (%)")
    _scale_shares(axes, 100)
    title = f"mean over {number} tasks, 95 % interval"
    tidy(axes, title + (_HOLLOW if any(line.paper for line in lines) else ""), grid=True)
    _name_lines(figure, lines)
    save_figure(figure, path)


def _draw_lines(axes: Axes, lines: Sequence[_Line]) -> None:
    """Draws bands, or whiskers next to each other for many lines or lines of one point."""
    whiskers = len(lines) > _BANDS or all(len(line.points) == 1 for line in lines)
    for index, line in enumerate(lines):
        (x, y, low, high), order = zip(*line.points, strict=True), 3 + (len(lines) - index) / 100
        color = line.style["color"]
        # shifted in inches, not in data units: the same distance at every scale
        aside = _ASIDE * (index - (len(lines) - 1) / 2) if whiskers else 0
        where = axes.transData + ScaledTranslation(aside, 0, axes.figure.dpi_scale_trans)
        if whiskers or len(x) == 1:  # a band needs two points
            axes.vlines(x, low, high, color=color, linewidth=0.9, alpha=0.55, zorder=order - 1, transform=where)
        else:
            axes.fill_between(x, low, high, color=color, alpha=0.13, linewidth=0, zorder=order - 1)
        axes.plot(x, y, **line.style, markersize=5, linewidth=1.6, markeredgewidth=0, zorder=order, transform=where)
        if line.paper:
            style = {**line.style, "linestyle": (0, (2, 2)), "markerfacecolor": "white", "markeredgewidth": 1.3}
            axes.plot(*zip(*sorted(line.paper), strict=True), **style, markersize=6.5, linewidth=1, zorder=order + 0.5)


def _name_lines(figure: Figure, lines: Sequence[_Line]) -> None:
    named = {line.name: Line2D([], [], **line.style, markersize=5, markeredgewidth=0) for line in lines}
    figure.legend(named.values(), named.keys(), loc="outside right upper", frameon=False, fontsize=8.5)


def _lines(
    summaries: Sequence[Summary], by: str, measure: str, factor: float, methods: Sequence[str] | None
) -> list[_Line]:
    """Returns a line per method; by demonstrations, with several label shares, one per method and share."""
    methods = list(methods or dict.fromkeys(item.method for item in summaries))
    shares = sorted({item.labels for item in summaries})
    several = by == "demonstrations" and len(shares) > 1
    styles, lines = method_styles(methods), dict[str, _Line]()
    for item in sorted(summaries, key=lambda item: (methods.index(item.method), item.mean(by) or 0)):
        place, found = item.mean(by), item.measures.get(measure)
        if place is None or found is None:
            continue
        name, style, share = item.method, styles[item.method], shares.index(item.labels)
        if several:  # colours stand for methods, markers and dashes for shares
            name = f"{name}, {percent(item.labels)}"
            style = style | {"marker": _MARKERS[share % len(_MARKERS)], "linestyle": _DASHES[share % len(_DASHES)]}
        values = (factor * value for value in (found.mean, found.low, found.high))
        lines.setdefault(name, _Line(name, style)).points.append((place, *values))
    several_places = [line for line in lines.values() if len(set(line.positions)) > 1]
    return several_places if by == "demonstrations" and several_places else list(lines.values())


def _scale_shares(axes: Axes, top: int) -> None:
    axes.set_ylim(-0.03 * top, 1.03 * top)
    axes.set_yticks([top * part / 5 for part in range(6)])


def _scale_errors(axes: Axes, lines: Sequence[_Line]) -> None:
    axes.set_yscale("log")
    ends = [end for line in lines for *_, low, high in line.points for end in (low, high)]
    low, high = min(ends), max(ends)
    wide = max(1.15, (2.2 * low / high) ** 0.5)  # the axis spans a factor of two at least: noise must not look large
    axes.set_ylim(low / wide, high * wide)
    span = high / low * wide**2
    axes.yaxis.set_major_locator(LogLocator(subs=range(1, 10) if span < 5 else (1, 2, 5) if span < 100 else (1,)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())


def _log_x(axes: Axes, lines: Sequence[_Line], *, ticks: bool) -> None:
    """Makes the axis logarithmic, with limits at the data and, for ``ticks``, ticks at the points that have room."""
    places = sorted({value for line in lines for value in [*line.positions, *(place for place, _ in line.paper)]})
    low, high = places[0], places[-1]
    margin = max(1.12, (high / low) ** 0.06) if len(places) > 1 else 2.0
    axes.set_xscale("log")
    axes.set_xlim(low / margin, high * margin)
    kept: list[float] = []
    for place in places:
        if not kept or place / kept[-1] > (high * margin**2 / low) ** 0.085:
            kept.append(place)
    if ticks or len(places) == 1:
        axes.xaxis.set_major_locator(FixedLocator(kept))
    elif high / low < 300:
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda value, _: percent(value) if ticks else f"{value:,.0f}")
