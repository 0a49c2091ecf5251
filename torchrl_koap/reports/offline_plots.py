# This source code is licensed under the MIT license found in the LICENSE file.
"""Charts of an evaluation on recorded data: errors of plans over the horizon, of actions by column."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import BLUE, MUTED, ORANGE, PALE_BLUE, RED, legend_beside, set_title, tidy
from torchrl_koap.tasks.units import thousandths

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
    "outside_budget": "labels outside the budget, for evaluation only",
    "left_out": "labels inside the budget, a trajectory left out at a time",
}
_MANY = 6  # from here on names of columns are turned


@picture(
    "plan_errors.png",
    source="eval.json",
    title="Errors of the plans",
    caption="On trajectories that the planner has never seen, for each planned step. Left: energy score of the sampled"
    " plans, which no second way of doing the task spoils; dashed, what needs no learning. Right: the best of the"
    " samples, in which a planner is to have what was recorded among its plans. A row per unit; distances over all"
    " columns of that unit together.",
    order=15,
    offline=True,
)
def draw_plan_errors(result: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws errors of sampled plans over the horizon beside those of baselines that need no learning.

    Args:
        result (mapping): ``eval.json`` with ``plan_errors``, as of
            :func:`~torchrl_koap.evaluation.plan_errors.plan_errors`.
    """
    plan = _part(result, "plan_errors")
    if "unit" not in plan:
        raise NothingToDraw("no plan was evaluated on recorded data")
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
            tidy(axes, grid=True)
        pair[0].set_ylabel(f"distance ({shown or 'units of the data'})")
        set_title(pair[0], f"energy score: {_list_names(row['columns'])}")
        set_title(pair[1], f"best of {plan['samples']} plans")
    each = f", {1e3 / run.control_hz:.0f} ms each" if run.control_hz else ""
    for axes in panels[-1]:
        axes.set_xlabel(f"planned step{each}")
    legend_beside(panels[0, 1])
    return figure


@picture(
    "action_errors.png",
    source="eval.json",
    title="Errors of the actions",
    caption="Root mean square error of the actions decoded from recorded states, a group of bars per action column."
    " Red: the controller does no better there than always giving the mean action. Controllers see recorded states"
    " here; planned ones are not as good.",
    order=16,
    offline=True,
)
def draw_action_errors(result: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws errors of decoded actions by column and unit, beside a ridge's and those of always giving the mean action.

    Args:
        result (mapping): ``eval.json`` with ``action_errors`` by split; notes are skipped.
    """
    parts = [(name, part) for name, part in _part(result, "action_errors").items() if "column" in part]
    if not parts:
        raise NothingToDraw("no action was evaluated on recorded data")
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
    return figure


def _draw_bars(axes: Axes, rows: Sequence[Mapping[str, Any]], unit: str) -> None:
    shown, factor = thousandths(unit)
    places = np.arange(len(rows))
    for offset, (name, (_, color)) in zip((-0.27, 0.0, 0.27), _ACTIONS.items(), strict=True):
        values = [factor * row.get(name, math.nan) for row in rows]
        worse = [name == "controller" and row[name] >= row["mean_action"] for row in rows]
        axes.bar(places + offset, values, width=0.25, color=[RED if bad else color for bad in worse])
    axes.set_xticks(places, [row["name"] for row in rows], rotation=45 if len(rows) > _MANY else 0)
    axes.set_xlim(-0.6, len(rows) - 0.4)
    axes.set_ylabel(f"RMSE ({shown or 'units of the data'})")
    axes.set_axisbelow(True)
    tidy(axes, grid=True)


def _part(result: Any, name: str) -> Mapping[str, Any]:
    """An entry of ``eval.json``; empty where it is absent, as in that of rollouts, or the file is damaged."""
    part = result.get(name) if isinstance(result, Mapping) else None
    return part if isinstance(part, Mapping) else {}


def _list_names(names: Sequence[str]) -> str:
    """Names of columns in a title, the middle of many left out."""
    return ", ".join(names) if len(names) <= 4 else f"{names[0]}, {names[1]}, ... {names[-1]} ({len(names)} columns)"
