# This source code is licensed under the MIT license found in the LICENSE file.
"""Charts of an evaluation without an environment: errors of plans over the horizon, of actions by column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.style import (
    BLUE,
    FAINT,
    MUTED,
    ORANGE,
    PALE_BLUE,
    RED,
    as_array,
    legend_beside,
    save_figure,
    set_title,
    thousandths,
    tidy,
)

_PLANS = {
    "planner": ("planner", BLUE, "solid"),
    "standing_still": ("standing still", MUTED, "dashed"),
    "constant_velocity": ("constant velocity", ORANGE, "dashed"),
}
_ACTIONS = {
    "controller": ("controller", BLUE),
    "ridge": ("ridge on raw frames", PALE_BLUE),
    "mean_action": ("always the mean action", MUTED),
}
_SPLITS = {
    "outside_budget": "labels outside the budget, for analysis only",
    "left_out": "labels inside the budget, a trajectory left out at a time",
}
_MOST_COLUMNS = 12  # panels of single state columns
_MANY = 6  # from here on names of columns are turned


@picture(
    "plan_errors.png",
    source="eval.json",
    title="Errors of the plans",
    caption="On trajectories that the planner has never seen, for each planned step. Left: energy score of the sampled"
    " plans, which no second way of doing the task spoils; dashed, what needs no learning. Right: the best of the"
    " samples, in which a planner is to have what was recorded among its plans. A row per unit; distances over all"
    " columns of that unit together.",
    command="koap eval {run}",
    place=15,
    recorded=True,
)
def _draw_plan_errors(result: Mapping[str, Any], path: Path, *, control_hz: float | None = None) -> Path:
    plan = _part(result, "plan_errors")
    if "unit" not in plan:
        raise NothingToDraw("no plan was judged on recorded data")
    return plot_plan_errors(plan, path, control_hz=control_hz)


def plot_plan_errors(plan: Mapping[str, Any], path: str | Path, *, control_hz: float | None = None) -> Path:
    """Errors of sampled plans over the horizon beside those of standing still and of constant velocity.

    Args:
        plan (mapping): of :func:`~torchrl_koap.evaluation.plan_errors.plan_errors`.
        path (str or Path): png to write.

    Keyword Args:
        control_hz (float, optional): control steps per second, for the label of the axis.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.offline_plots import plot_plan_errors
        >>> score = {"overall": 1.5, "per_step": [1.0, 2.0]}
        >>> row = {name: {"energy_score": score, "best_of": score} for name in _PLANS} | {"unit": "m", "columns": ["x"]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_plan_errors({"unit": [row], "samples": 16, "situations": 9}, f"{folder}/plan_errors.png").name
        'plan_errors.png'
    """
    rows = plan["unit"]
    figure = Figure(figsize=(8.8, 0.9 + 2.9 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), 2, squeeze=False, sharex=True, sharey="row")
    for row, pair in zip(rows, panels, strict=True):
        shown, factor = thousandths(row["unit"])
        for kind, axes in zip(("energy_score", "best_of"), pair, strict=True):
            for name, (label, color, dash) in _PLANS.items():
                values = factor * np.asarray(row[name][kind]["per_step"], dtype=float)
                steps = np.arange(1, len(values) + 1)
                axes.plot(steps, values, color=color, linestyle=dash, linewidth=1.6, label=label)
            axes.set_ylim(bottom=0)
            axes.xaxis.set_major_locator(MaxNLocator(7, integer=True))
            axes.grid(axis="y", color=FAINT, linewidth=0.5)
            tidy(axes)
        what = f"distance ({shown})" if shown else "distance (units of the data)"
        pair[0].set_ylabel(what)
        set_title(pair[0], f"energy score: {_list_names(row['columns'])}")
        set_title(pair[1], f"best of {plan['samples']} plans")
    each = f", {1e3 / control_hz:.0f} ms each" if control_hz else ""
    for axes in panels[-1]:
        axes.set_xlabel(f"planned step{each}")
    legend_beside(panels[0, 1])
    return save_figure(figure, path)


@picture(
    "action_errors.png",
    source="eval.json",
    title="Errors of the actions",
    caption="Root mean square error of the actions decoded from recorded states, a group of bars per action column."
    " Red: the controller does no better there than always giving the mean action. Controllers see recorded states"
    " here; planned ones are not as good.",
    command="koap eval {run}",
    place=16,
    recorded=True,
)
def _draw_action_errors(result: Mapping[str, Any], path: Path) -> Path:
    errors = _part(result, "action_errors")
    if not any("column" in part for part in errors.values()):
        raise NothingToDraw("no action was judged on recorded data")
    return plot_action_errors(errors, path)


def plot_action_errors(errors: Mapping[str, Mapping[str, Any]], path: str | Path) -> Path:
    """Errors of decoded actions by column and unit, beside a ridge's and those of always giving the mean action.

    Args:
        errors (mapping): by split, of :func:`~torchrl_koap.evaluation.label_errors.summarise_errors`; notes are
            skipped.
        path (str or Path): png to write.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.offline_plots import plot_action_errors
        >>> column = {"name": "dq1", "unit": "rad", "controller": 0.1, "ridge": 0.2, "mean_action": 0.3}
        >>> left_out = {"column": [column], "labels": 40, "trajectories": 2}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_action_errors({"left_out": left_out}, f"{folder}/action_errors.png").name
        'action_errors.png'
    """
    parts = [(name, part) for name, part in errors.items() if "column" in part]
    units = list(dict.fromkeys(row["unit"] for _, part in parts for row in part["column"]))
    counts = [sum(row["unit"] == unit for row in parts[0][1]["column"]) for unit in units]
    figure = Figure(figsize=(3.6 + 0.62 * sum(counts) + 1.2 * len(units), 0.8 + 2.9 * len(parts)), layout="constrained")
    widths = [1 + count for count in counts]
    panels = figure.subplots(len(parts), len(units), squeeze=False, width_ratios=widths)
    for (name, part), line in zip(parts, panels, strict=True):
        for unit, axes in zip(units, line, strict=True):
            _draw_bars(axes, [row for row in part["column"] if row["unit"] == unit], unit)
        judged = f"{part['labels']:,} labels of {part['trajectories']} trajectories"
        set_title(line[0], f"{_SPLITS.get(name, name)}\n{judged}")
    handles = [Line2D([], [], color=color, linewidth=6, label=label) for label, color in _ACTIONS.values()]
    if any(row["controller"] >= row["mean_action"] for _, part in parts for row in part["column"]):
        handles.append(Line2D([], [], color=RED, linewidth=6, label="controller, no better than the mean"))
    legend_beside(panels[0, -1], handles=handles)
    return save_figure(figure, path)


def _draw_bars(axes: Axes, rows: Sequence[Mapping[str, Any]], unit: str) -> None:
    shown, factor = thousandths(unit)
    places = np.arange(len(rows))
    for offset, (name, (_, color)) in zip((-0.27, 0.0, 0.27), _ACTIONS.items(), strict=True):
        values = [factor * row.get(name, math.nan) for row in rows]
        worse = [name == "controller" and row[name] >= row["mean_action"] for row in rows]
        axes.bar(places + offset, values, width=0.25, color=[RED if bad else color for bad in worse])
    axes.set_xticks(places, [row["name"] for row in rows], rotation=45 if len(rows) > _MANY else 0)
    axes.set_xlim(-0.6, len(rows) - 0.4)
    axes.set_ylabel(f"RMSE ({shown})" if shown else "RMSE (units of the data)")
    axes.grid(axis="y", color=FAINT, linewidth=0.5)
    axes.set_axisbelow(True)
    tidy(axes)


def plot_columns(
    demonstrations: Mapping[str, Any],
    path: str | Path,
    *,
    columns: Sequence[tuple[str, str]],
    control_hz: float | None = None,
) -> Path:
    """State columns of the demonstrations over time; what has an action label is emphasised.

    Args:
        demonstrations (mapping): ``state`` [N, d], ``episode`` [N] and ``labelled`` [N].
        path (str or Path): png to write.

    Keyword Args:
        columns (sequence): name and unit of every state column.
        control_hz (float, optional): control steps per second. Default: time is counted in steps.

    Raises:
        ValueError: if shapes disagree.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.reports.offline_plots import plot_columns
        >>> data = {"state": torch.rand(6, 1), "episode": [0, 0, 0, 1, 1, 1], "labelled": [True] * 3 + [False] * 3}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_columns(data, f"{folder}/demonstrations.png", columns=[("q1", "rad")]).name
        'demonstrations.png'
    """
    state = as_array("state", demonstrations["state"], [None, len(columns)])
    episode = as_array("episode", demonstrations["episode"], [len(state)])
    labelled = as_array("labelled", demonstrations["labelled"], [len(state)]).astype(bool)
    borders = np.flatnonzero(np.diff(episode) != 0) + 1
    first = np.concatenate([[0], borders]).astype(int)
    since = np.arange(len(state)) - np.repeat(first, np.diff(np.append(first, len(state))))
    time = since / control_hz if control_hz else since.astype(float)
    drawn = columns[:_MOST_COLUMNS]
    across = min(len(drawn), 4)
    down = -(-len(drawn) // across)
    figure = Figure(figsize=(max(2.9 * across, 5.6), 1.1 + 2.1 * down), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False)
    along = np.flatnonzero(labelled[:-1] & (episode[1:] == episode[:-1]))
    for index, axes in enumerate(panels.flat):
        if index >= len(drawn):
            axes.set_axis_off()
            continue
        points = np.column_stack([time, state[:, index]])
        lines = np.split(points, borders)
        axes.add_collection(LineCollection(lines, colors="#9aa1ab", linewidths=0.6, alpha=0.7))
        axes.add_collection(
            LineCollection(np.stack([points[along], points[along + 1]], 1), colors=BLUE, linewidths=1.3)
        )
        axes.autoscale_view()
        name, unit = columns[index]
        set_title(axes, f"{name} ({unit})" if unit else name)
        if index + across >= len(drawn):
            axes.set_xlabel("time (s)" if control_hz else "step")
        tidy(axes)
    share = f"{labelled.mean():.1%}" if len(labelled) else "none"
    touched = len(np.unique(episode[labelled]))
    rest = f"; {len(columns) - len(drawn)} further columns are not drawn" if len(drawn) < len(columns) else ""
    figure.suptitle(
        f"{len(first)} demonstrations; labels on {int(labelled.sum()):,} of {len(labelled):,} transitions ({share})"
        f" in {touched} of them{rest}",
        fontsize=9.5,
        x=0.01,
        ha="left",
    )
    handles = [
        Line2D([], [], color=BLUE, linewidth=1.7, label="with action label"),
        Line2D([], [], color="#9aa1ab", linewidth=0.9, label="states only"),
    ]
    figure.legend(handles=handles, fontsize=8.5, loc="outside lower center", ncols=2, frameon=False)
    return save_figure(figure, path)


def _part(result: Any, name: str) -> Mapping[str, Any]:
    """An entry of ``eval.json``; empty where it is absent, as in that of rollouts, or the file is damaged."""
    part = result.get(name) if isinstance(result, Mapping) else None
    return part if isinstance(part, Mapping) else {}


def _list_names(names: Sequence[str]) -> str:
    """Names of columns in a title, the middle of many left out."""
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, {names[1]}, ... {names[-1]} ({len(names)} columns)"
