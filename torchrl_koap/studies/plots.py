# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures of a label-efficiency curve: success and action error against the labels, a line per method.

Colours stay apart for colour-blind readers; markers and dashes tell the lines apart without any colour. Names stand
beside the ends of the lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, LogLocator, NullFormatter, NullLocator

from torchrl_koap.reports.style import FAINT, INK, set_title, tidy
from torchrl_koap.reports.writing import save_figure
from torchrl_koap.studies.lines import DASHES, MARKERS, Line, draw_lines, method_styles, name_lines
from torchrl_koap.studies.summary import Summary, percent

AXES = {
    "fraction": "labelled share",
    "labelled_transitions": "distinct labelled transitions",
    "observations": "trajectories used, share of all",
}


def plot_success(
    summaries: Sequence[Summary],
    path: str | Path,
    *,
    by: Sequence[str] = ("fraction", "labelled_transitions"),
    paper: Sequence[Mapping[str, Any]] = (),
    methods: Sequence[str] | None = None,
    label: str = "",
) -> Path:
    """Success of every method with its 95 % interval, a panel per entry of ``by``.

    Args:
        summaries (sequence of Summary): of one task, see :func:`~torchrl_koap.studies.summary.summarise`.
        path (str or Path): png to write.

    Keyword Args:
        by (sequence of str): what the horizontal axes show, of :data:`AXES`. Along ``"observations"`` there is a line
            per method and label budget that was run with several shares.
        paper (sequence of mapping): the paper's figures, with ``method``, ``fraction`` and ``success`` in 0..1: hollow
            and dashed, in the colour of the method. Drawn only along ``"fraction"``.
        methods (sequence of str, optional): all methods in the order that gives the colours; without it those of the
            summaries in theirs.
        label (str): what the budget counts, as in the label of the axis: ``"windows"``.

    Raises:
        ValueError: if no cell of any method is done.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.studies.plots import plot_success
        >>> from torchrl_koap.studies.summary import summarise
        >>> cell = {"task": "avoiding", "method": "koap", "seed": 0, "status": "done", "episodes": 9, "successes": 5}
        >>> rows = [cell | {"fraction": fraction} for fraction in (0.01, 0.1)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_success(summarise(rows), f"{folder}/success.png", by=["fraction"]).name
        'success.png'
    """
    panels = []
    for name in by:
        lines = _lines(summaries, name, ("success", "low", "high"), methods)
        for line in lines.values():
            if name == "fraction":
                line.paper = [(row["fraction"], 100 * row["success"]) for row in paper if row["method"] == line.name]
            line.y, line.low, line.high = ([100 * value for value in part] for part in (line.y, line.low, line.high))
        panels.append((name, [line for line in lines.values() if line.x]))
    panels = [panel for panel in panels if panel[1]]
    if not panels:
        raise ValueError("there is no success to draw: no cell is done")
    figure = Figure(figsize=(1.9 + 4.1 * len(panels), 4.1), layout="constrained")
    for index, (name, drawn) in enumerate(panels):
        axes = figure.add_subplot(1, len(panels), index + 1)
        draw_lines(axes, drawn)
        axes.set_ylim(-3, 103)
        axes.set_yticks(range(0, 101, 20))
        axes.set_xlabel(AXES[name] + (f" ({label})" if label and name == "fraction" else ""))
        if index == 0:
            axes.set_ylabel("success (%)")
        _log_x(axes, drawn, ticks=name != "labelled_transitions")
        axes.grid(axis="y", color=FAINT, linewidth=0.5)
        title = "success, 95 % interval"
        if any(line.paper for line in drawn):
            title += "\nhollow, dashed: the paper, whose demonstrations are others"
        set_title(axes, title if index == 0 else "")
        tidy(axes)
        if index == len(panels) - 1 or {line.name for line in drawn} - {line.name for line in panels[-1][1]}:
            name_lines(axes, drawn)
    return save_figure(figure, path)


def plot_action_error(
    summaries: Sequence[Summary],
    path: str | Path,
    *,
    unit: str = "",
    methods: Sequence[str] | None = None,
    label: str = "",
    relative: bool = False,
) -> Path:
    """Error of the predicted actions against the labelled share, both logarithmic; bands from best to worst seed.

    Args:
        summaries (sequence of Summary): of one task.
        path (str or Path): png to write.

    Keyword Args:
        unit (str): unit of the error.
        methods (sequence of str, optional): see :func:`plot_success`.
        label (str): what the budget counts.
        relative (bool): draw the share of the mean action's error instead, with a line at 1.

    Raises:
        ValueError: if no cell has an action error above 0.
    """
    wanted = tuple(f"{'relative_' if relative else ''}action_error{end}" for end in ("", "_low", "_high"))
    lines = [line for line in _lines(summaries, "fraction", wanted, methods).values() if line.x]
    if not lines or min(min(line.low) for line in lines) <= 0:
        raise ValueError("there is no action error above 0 to draw")
    head = "action error, share of the mean action's" if relative else "action error"
    figure, axes = _from_best_to_worst(lines, label, f"{head} ({unit})" if unit else head)
    if relative:
        axes.axhline(1, color=INK, linewidth=0.8, linestyle=(0, (2, 2)), zorder=1)
    axes.set_yscale("log")
    low, high = min(min(line.low) for line in lines), max(max(line.high) for line in lines)
    wide = max(1.15, (2.2 * low / high) ** 0.5)  # at least a factor of two is shown, or chance looks like a trend
    axes.set_ylim(low / wide, high * wide)
    _log_y_ticks(axes)
    axes.grid(axis="y", which="both", color=FAINT, linewidth=0.5)
    name_lines(axes, lines)
    return save_figure(figure, path)


def plot_entropy(
    summaries: Sequence[Summary], path: str | Path, *, methods: Sequence[str] | None = None, label: str = ""
) -> Path:
    """Entropy of the modes of successful rollouts against the labelled share; bands from best to worst seed.

    Args:
        summaries (sequence of Summary): of one task.
        path (str or Path): png to write.

    Keyword Args:
        methods (sequence of str, optional): see :func:`plot_success`.
        label (str): what the budget counts.

    Raises:
        ValueError: if no cell has an entropy.
    """
    wanted = ("entropy", "entropy_low", "entropy_high")
    lines = [line for line in _lines(summaries, "fraction", wanted, methods).values() if line.x]
    if not lines:
        raise ValueError("there is no entropy to draw")
    figure, axes = _from_best_to_worst(lines, label, "entropy of the modes")
    axes.set_ylim(-0.03, 1.03)
    axes.grid(axis="y", color=FAINT, linewidth=0.5)
    name_lines(axes, lines)
    return save_figure(figure, path)


def _from_best_to_worst(lines: Sequence[Line], label: str, name: str) -> tuple[Figure, Axes]:
    """A single panel along the labelled share, limits and grid of the other axis left to the caller."""
    figure = Figure(figsize=(6, 4.1), layout="constrained")
    axes = figure.add_subplot()
    draw_lines(axes, lines)
    axes.set_xlabel(AXES["fraction"] + (f" ({label})" if label else ""))
    axes.set_ylabel(name)
    _log_x(axes, lines, ticks=True)
    set_title(axes, "mean over seeds, from best to worst seed")
    tidy(axes)
    return figure, axes


def _lines(
    summaries: Sequence[Summary], by: str, wanted: Sequence[str], methods: Sequence[str] | None
) -> dict[Any, Line]:
    """A line per method; along the trajectories used one per method and budget."""
    methods = list(methods or dict.fromkeys(item.method for item in summaries))
    fractions = sorted({item.fraction for item in summaries})
    several = by == "observations" and len(fractions) > 1
    keys = [(method, fraction) for method in methods for fraction in (fractions if several else [None])]
    names = [f"{method}, {percent(fraction)}" if several else method for method, fraction in keys]
    styles = method_styles(methods)
    if several:  # colour tells the method, marker and dashes the budget
        places = {fraction: {"marker": MARKERS[n % 13], "dash": DASHES[n % 3]} for n, fraction in enumerate(fractions)}
        lines = {key: Line(name, **styles[key[0]] | places[key[1]]) for key, name in zip(keys, names, strict=True)}
    else:
        lines = {key: Line(name, **styles[name]) for key, name in zip(keys, names, strict=True)}
    for item in sorted(summaries, key=lambda item: getattr(item, by) or 0):
        values = [getattr(item, name) for name in (by, *wanted)]
        if item.method not in methods or any(value is None for value in values):
            continue
        line = lines[item.method, item.fraction if several else None]
        for part, value in zip((line.x, line.y, line.low, line.high), values, strict=True):
            part.append(value)
    if by == "observations" and any(len(set(line.x)) > 1 for line in lines.values()):
        return {key: line for key, line in lines.items() if len(set(line.x)) > 1}  # the others do not scale anything
    return lines


def _log_x(axes: Axes, lines: Sequence[Line], *, ticks: bool) -> None:
    """Logarithmic axis that ends at the data; ``ticks`` at the places themselves, where there is room."""
    places = sorted({value for line in lines for value in [*line.x, *(place for place, _ in line.paper)]})
    positive = [place for place in places if place > 0] or [1.0]
    low, high = positive[0], max(positive[-1], positive[0])
    margin = max(1.12, (high / low) ** 0.06) if len(positive) > 1 else 2.0
    if places[0] > 0:
        axes.set_xscale("log")
        axes.set_xlim(low / margin, high * margin)
    else:  # a budget of nothing has its place left of the logarithmic part
        axes.set_xscale("symlog", linthresh=low, linscale=0.3)
        axes.set_xlim(-0.3 * low, high * margin)
    kept: list[float] = []
    for place in places:
        if not kept or not kept[-1] or place / kept[-1] > (high * margin**2 / low) ** 0.085:
            kept.append(place)
    if ticks or len(positive) == 1 or places[0] <= 0:
        axes.xaxis.set_major_locator(FixedLocator(kept))
    elif high / low < 300:
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(lambda value, _: percent(value) if ticks else f"{value:,.0f}")


def _log_y_ticks(axes: Axes) -> None:
    low, high = axes.get_ylim()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high / low < 100 else (1,)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
