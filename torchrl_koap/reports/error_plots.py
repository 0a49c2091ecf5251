# This source code is licensed under the MIT license found in the LICENSE file.
"""Charts of losses, and of errors of plans and actions."""

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
from torchrl_koap.reports.style import (
    BLUE,
    FAINT,
    MUTED,
    ORANGE,
    PALE_BLUE,
    RED,
    WARNING,
    entry,
    panels,
    put_legend,
    set_title,
    shorten,
    tidy,
    with_unit,
)
from torchrl_koap.tasks.columns import thousandths

_ROUND = (1, 2, 5, 10)
TERMS = {
    "loss_planner": "planner",
    "loss_reconstruction": "reconstruction",
    "loss_koopman": "linear latent dynamics",
    "loss_action": "action decoder (labelled steps)",
    "held_out_score": "plan score, held-out recordings",
}
_PLANS = {
    "planner": ("planner", BLUE, "solid"),
    "standing_still": ("standing still", MUTED, "dashed"),
    "constant_velocity": ("constant velocity", ORANGE, "dashed"),
}
_ACTIONS = {
    "controller": ("controller", BLUE),
    "ridge": ("ridge on raw frames", PALE_BLUE),
}
_SPLITS = {
    "outside_budget": "labels outside the budget, for evaluation only",
    "left_out": "each labelled recording in turn left out of the fit",
}
_MANY = 6  # column names are rotated if there are more


@picture(
    "losses.png",
    source="metrics.csv",
    title="Losses",
    caption="Logarithmic scale. Pale: logged values; line: running mean of their logarithms; number: its last value."
    " The dot marks the weights that were kept. A planner's loss has no absolute scale: judge it by rollouts, or by the"
    " plan score, which falls as plans approach recordings.",
    order=100,
)
def draw_losses(rows: Sequence[Mapping[str, str]], run: RunFacts) -> Figure:
    """Draws loss curves, a panel per term, logarithmic; raw values pale, a running mean on top.

    Rows have ``step`` and any number of ``loss_*``, empty if a term does not belong to the row.
    """
    if not rows:
        raise ValueError("metrics.csv has no rows yet")
    names = [name for name in TERMS if name in rows[0]]
    names += sorted(name for name in rows[0] if name.startswith("loss_") and name not in TERMS)
    step, columns = _column(rows, "step"), {name: _column(rows, name) for name in names}
    columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    figure, drawn = panels(len(columns), 2, (4.2, 2.7))
    for axes, (name, values) in zip(drawn, columns.items(), strict=True):
        set_title(axes, TERMS.get(name, name.removeprefix("loss_").replace("_", " ")))
        axes.set_xlabel("update")
        here = np.isfinite(values)
        x, y = step[here], values[here]
        if (y > 0).any():
            y = np.where(y > 0, y, np.nan)
            smooth = np.exp(running_mean(np.log(y), max(1, len(y) // 40)))
            note = f"{smooth[np.isfinite(smooth)][-1]:.3g}"
            if name == "held_out_score":
                kept = int(np.searchsorted(x, _column(rows, "kept_update")[here][-1]))
                axes.plot(x[kept], y[kept], "o", color=BLUE, markersize=5)
                last = f"; last: {y[-1]:.3g}" if kept < len(x) - 1 else ""
                note = f"kept: {y[kept]:.3g}, update {x[kept]:,.0f}{last}"
            axes.plot(x, y, color=BLUE, alpha=0.25, linewidth=0.7)
            axes.plot(x, smooth, color=BLUE, linewidth=1.6, marker="o" if len(x) == 1 else "")
            axes.set_yscale("log")
            low, high = np.nanmin(y), np.nanmax(y)
            widen = max(1.0, 4 * low / high) ** 0.5  # so that a flat curve looks flat
            axes.set_ylim(low / widen / 1.15, high * widen * 1.15)
            axes.grid(axis="y", which="major", color=FAINT, linewidth=0.5)
            axes.annotate(note, (1, 0.97), xycoords="axes fraction", ha="right", va="top", fontsize=9, color=BLUE)
        else:
            fitted = name == "loss_action" and "decoder_fit" in run.summary
            why = "it is fitted in closed form\nafter the last update" if fitted else "this loss used no label"
            axes.text(0.5, 0.5, f"0 throughout: {why}", transform=axes.transAxes, ha="center", color=MUTED)
            axes.update_datalim(np.column_stack([x, y]))  # the updates of its part, as in the other panels
            axes.autoscale_view()
            axes.set_yticks([])
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True, steps=_ROUND))
        tidy(axes)
    return figure


def _column(rows: Sequence[Mapping[str, str]], name: str) -> np.ndarray:
    return np.array([float(row[name]) if row[name] else np.nan for row in rows])


def running_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Returns the mean of values ``[N]`` within ``reach`` places, ignoring NaN; NaN where there is none."""
    there = np.isfinite(values)
    sums = [np.convolve(part, np.ones(2 * reach + 1)) for part in (np.where(there, values, 0.0), there)]
    total, count = (part[reach : reach + len(values)] for part in sums)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@picture(
    "actions.png",
    source="actions.safetensors",
    title="Predicted against recorded actions",
    caption="Uses all actions of demonstrations outside the label budget, for evaluation only: nothing was trained or"
    " selected with them. Points on the diagonal are exact. A slope below 1 means that actions are too small.",
    order=90,
)
def draw_actions(data: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws ``predicted`` against ``true`` actions ``[N, d]``, a panel per column, in thousandths of their units.

    They are of demonstrations outside the budget, read for evaluation only, as the title says.
    """
    true = entry(data, "true", [None, None])
    predicted, width = entry(data, "predicted", true.shape), true.shape[1]
    names, units = [f"action {index + 1}" for index in range(width)], [""] * width
    absolute: tuple[str, ...] = ()
    if run.task is not None and run.task.action_dim == width:
        names, units = list(run.task.actions), [action.unit for action in run.task.actions.values()]
        absolute = tuple(name for name, action in run.task.actions.items() if action.kind != "delta")
    shown, factor = zip(*map(thousandths, units), strict=True)
    true, predicted = true * factor, predicted * factor
    error = predicted - true
    figure, drawn = panels(width, width if width < 5 else min(-(-width // 2), 5), (3.2, 3.4), (0.6, 0.35))
    for index, (axes, name) in enumerate(zip(drawn, names, strict=True)):
        _scatter(axes, true[:, index], predicted[:, index])
        rate = name in absolute or "/" in shown[index]
        each, name = " ".join(filter(None, (shown[index], "" if rate else "per step"))), shorten(name)
        axes.set_xlabel(with_unit(f"recorded {name}", each))
        axes.set_ylabel(with_unit(f"predicted {name}", each))
        set_title(axes, f"{name}: RMSE {np.sqrt(np.square(error[:, index]).mean()):.3g} {shown[index]}".rstrip())
    title = f"{len(true):,} steps of demonstrations outside the label budget, for evaluation only"
    figure.suptitle(title, fontsize=10, color=WARNING, x=0.01, ha="left")
    return figure


def _scatter(axes: Axes, true: np.ndarray, predicted: np.ndarray) -> None:
    low, high = np.quantile(np.concatenate([true, predicted]), [0.0005, 0.9995])
    margin = 0.06 * (high - low) + 1e-9
    span = (low - margin, high + margin)
    axes.plot(span, span, color=MUTED, linewidth=0.8, zorder=1)
    size, opacity = float(np.clip(3000 / len(true), 1.5, 14)), float(np.clip(600 / len(true), 0.12, 0.7))
    axes.scatter(true, predicted, s=size, color=BLUE, alpha=opacity, linewidths=0, zorder=2)
    axes.set(xlim=span, ylim=span, box_aspect=1)
    axes.xaxis.set_major_locator(MaxNLocator(6, steps=_ROUND))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=_ROUND))
    tidy(axes)


@picture(
    "plan_errors.png",
    source="eval.json",
    title="Errors of the plans",
    caption="Measured on held-out recordings, which only chose the planner's weights, for each planned step. Lower is"
    " better."
    " Left: the energy score, which is the distance of the plans from the recording, less half of the distance between"
    " plans. Right: the distance of the nearest plan. Dashed lines need no learning. Each row of panels is one unit; a"
    " distance is over all columns of that unit.",
    order=15,
    offline=True,
)
def draw_plan_errors(result: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws errors of sampled plans over the horizon, and those of baselines that need no learning."""
    plan = result.get("plan_errors", {})
    if "unit" not in plan:
        raise NothingToDraw("no plan was evaluated on recorded data")
    rows = plan["unit"]
    figure = Figure(figsize=(8.8, 0.9 + 2.9 * len(rows)), layout="constrained")
    grid = figure.subplots(len(rows), 2, squeeze=False, sharex=True, sharey="row")
    for row, pair in zip(rows, grid, strict=True):
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
        set_title(pair[0], f"energy score\n{_list_names(row['columns'])}")
        set_title(pair[1], f"nearest of {plan['samples']} plans\n")
    each = f", {1e3 / run.control_hz:.0f} ms each" if run.control_hz else ""
    for axes in grid[-1]:
        axes.set_xlabel(f"planned step{each}")
    put_legend(grid[0, 1])
    return figure


@picture(
    "action_errors.png",
    source="eval.json",
    title="Errors of the actions",
    caption="Root mean square error of the actions predicted from recorded states, relative to that of always giving"
    " the mean action (dashed; for absolute actions the mean distance to their target columns). Lower is better. The"
    " number below each action is the controller's error in its unit. Red bars are actions for which the controller is"
    " no better than the mean. On the robot the controller reads planned states, and its errors are larger.",
    order=16,
    offline=True,
)
def draw_action_errors(result: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws errors of decoded actions and of a ridge by column, relative to those of the mean action."""
    parts = [(name, part) for name, part in result.get("action_errors", {}).items() if "column" in part]
    if not parts:
        raise NothingToDraw("no action was evaluated on recorded data")
    count = len(parts[0][1]["column"])
    figure = Figure(
        figsize=(4.8 + (0.5 if count > _MANY else 0.8) * count, 0.8 + 2.9 * len(parts)), layout="constrained"
    )
    rows = figure.subplots(len(parts), squeeze=False)[:, 0]
    for (name, part), axes in zip(parts, rows, strict=True):
        _draw_shares(axes, part["column"])
        judged = f"{part['labels']:,} labels of {part['trajectories']} recording{'s' * (part['trajectories'] > 1)}"
        set_title(axes, f"{_SPLITS.get(name, name)}\n{judged}")
    handles = [Line2D([], [], color=color, linewidth=6, label=label) for label, color in _ACTIONS.values()]
    if any(row["controller"] >= row["mean_action"] > 0 for _, part in parts for row in part["column"]):
        handles.append(Line2D([], [], color=RED, linewidth=6, label="controller, no better than the mean"))
    handles.append(Line2D([], [], color=MUTED, linestyle="dashed", label="always the mean action"))
    put_legend(rows[0], handles=handles)
    return figure


def _draw_shares(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    places, names = np.arange(len(rows)), []
    for offset, (name, (_, color)) in zip((-0.17, 0.17), _ACTIONS.items(), strict=True):
        shares = [row.get(name, math.nan) / (row["mean_action"] or math.nan) for row in rows]
        worse = [name == "controller" and row[name] >= row["mean_action"] for row in rows]
        axes.bar(places + offset, shares, width=0.3, color=[RED if bad else color for bad in worse])
    axes.axhline(1, color=MUTED, linestyle="dashed")
    for row in rows:
        shown, factor = thousandths(row["unit"])
        names.append(f"{shorten(row['name'])}\n{factor * row['controller']:.2g} {shown}".rstrip())
    axes.set_xticks(places, names, rotation=45 if len(rows) > _MANY else 0)
    axes.set_xlim(-0.6, len(rows) - 0.4)
    axes.set_ylabel("RMSE, share of the mean's")
    axes.set_axisbelow(True)
    tidy(axes, grid=True)


def _list_names(names: Sequence[str]) -> str:
    names = [shorten(name) for name in names]
    return ", ".join(names) if len(names) <= 3 else f"{names[0]} ... {names[-1]} ({len(names)} columns)"
