# This source code is licensed under the MIT license found in the LICENSE file.
"""Charts of the training: losses, and predicted against recorded actions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_koap.reports.pictures import picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import BLUE, FAINT, MUTED, WARNING, entry, set_title, tidy
from torchrl_koap.tasks.units import thousandths

_ROUND = (1, 2, 5, 10)
TERMS = {
    "loss_planner": "planner",
    "loss_reconstruction": "reconstruction",
    "loss_koopman": "linear latent dynamics",
    "loss_action": "action decoder (labelled steps)",
    "held_out_score": "plan error, held-out demonstrations",
}


@picture(
    "losses.png",
    source="metrics.csv",
    title="Losses",
    caption="Pale: logged values; line: running mean, its last value in the corner. Logarithmic. Of the plan error,"
    " standing still has 1; the weights with the least one (dot) are kept. A planner's loss says little about its"
    " rollouts: look at the pictures above.",
    order=100,
)
def draw_losses(rows: Sequence[Mapping[str, str]], run: RunFacts) -> Figure:
    """Draws loss curves, a panel per term, logarithmic; raw values pale, a running mean on top.

    Args:
        rows (sequence): rows of ``metrics.csv`` with ``step`` and any number of ``loss_*``, empty where a term does not
            belong to the row.
    """
    if not rows:
        raise ValueError("no row has been logged yet")
    names = [name for name in TERMS if name in rows[0]]
    names += sorted(name for name in rows[0] if (name or "").startswith("loss_") and name not in TERMS)
    step, columns = _column(rows, "step"), {name: _column(rows, name) for name in names}
    columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    if not columns:
        raise ValueError(f"metrics hold no value of any loss_* column, got the columns {', '.join(map(str, rows[0]))}")

    across = min(len(columns), 2)
    down = math.ceil(len(columns) / across)
    figure = Figure(figsize=(4.2 * across, 2.7 * down), layout="constrained")
    for index, (name, values) in enumerate(columns.items()):
        axes = figure.add_subplot(down, across, index + 1)
        set_title(axes, TERMS.get(name, name.removeprefix("loss_").replace("_", " ")))
        axes.set_xlabel("training step")
        here = np.isfinite(values)
        x, y = step[here], values[here]
        if (y > 0).any():
            y = np.where(y > 0, y, np.nan)
            smooth = running_mean(y, max(1, len(y) // 40))
            note = f"{smooth[np.isfinite(smooth)][-1]:.3g}"
            if name == "held_out_score":
                best = int(np.nanargmin(y))
                axes.plot(x[best], y[best], "o", color=BLUE, markersize=5)
                note = f"kept: {y[best]:.3g}, update {x[best]:,.0f}" + (
                    f"; last: {y[-1]:.3g}" if y[-1] > y[best] else ""
                )
            axes.plot(x, y, color=BLUE, alpha=0.25, linewidth=0.7)
            axes.plot(x, smooth, color=BLUE, linewidth=1.6)
            axes.set_yscale("log")
            low, high = np.nanmin(y), np.nanmax(y)
            widen = max(1.0, 4 * low / high) ** 0.5  # a flat curve looks flat
            axes.set_ylim(low / widen / 1.15, high * widen * 1.15)
            axes.grid(axis="y", which="major", color=FAINT, linewidth=0.5)
            axes.annotate(note, (1, 0.97), xycoords="axes fraction", ha="right", va="top", fontsize=9, color=BLUE)
        else:
            axes.text(
                0.5, 0.5, "0 throughout: no label entered this loss", transform=axes.transAxes, ha="center", color=MUTED
            )
            axes.set_yticks([])
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True, steps=_ROUND))
        tidy(axes)
    return figure


def _column(rows: Sequence[Mapping[str, str]], name: str) -> np.ndarray:
    return np.array([float(row[name]) if row[name] else np.nan for row in rows])


def running_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Returns the mean of the values ``[N]`` at most ``reach`` places away without NaN; NaN where there is none."""
    there = np.isfinite(values)
    sums = [np.convolve(part, np.ones(2 * reach + 1)) for part in (np.where(there, values, 0.0), there)]
    total, count = (part[reach : reach + len(values)] for part in sums)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@picture(
    "actions.png",
    source="actions.safetensors",
    title="Predicted against recorded actions",
    caption="Uses all actions, for evaluation only: those of demonstrations outside the label budget, which trained and"
    " selected nothing. Points on the diagonal are exact; a slope below 1 means timid actions, points beside it drift.",
    order=90,
)
def draw_actions(data: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws predicted against recorded actions, a panel per dimension.

    The recorded actions are those of demonstrations outside the budget, read for evaluation only; the title says so.
    Metres, radians, seconds and newtons are shown in thousandths.

    Args:
        data (mapping): ``predicted`` and ``true`` actions ``[N, d]``.
        run (RunFacts): the run, whose task names the columns.
    """
    true = entry(data, "true", [None, None])
    predicted, width = entry(data, "predicted", true.shape), true.shape[1]
    names, units = [f"action {index + 1}" for index in range(width)], [""] * width
    absolute: tuple[str, ...] = ()
    if run.task is not None and run.task.action_dim == width:
        names, units = list(run.task.actions), [action.unit for action in run.task.actions.values()]
        absolute = tuple(name for name, action in run.task.actions.items() if action.kind != "delta")
    there = np.isfinite(true).all(1) & np.isfinite(predicted).all(1)
    if not there.any():
        raise ValueError(f"'predicted' and 'true' have no row of {len(true)} that is finite in both")
    shown, factor = zip(*map(thousandths, units), strict=True)
    true, predicted = true[there] * factor, predicted[there] * factor
    error = predicted - true
    across = width if width < 5 else -(-width // 2)
    down = -(-width // across)
    figure = Figure(figsize=(3.2 * across + 0.6, 3.4 * down + 0.35), layout="constrained")
    for index, name in enumerate(names):
        axes = figure.add_subplot(down, across, index + 1)
        _scatter(axes, true[:, index], predicted[:, index])
        each = " ".join(filter(None, (shown[index], "" if name in absolute else "per step")))
        axes.set_xlabel(f"recorded {name} ({each})" if each else f"recorded {name}")
        axes.set_ylabel(f"predicted {name} ({each})" if each else f"predicted {name}")
        set_title(axes, f"{name}: RMSE {_rms(error[:, index]):.3g} {shown[index]}".rstrip())
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


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))
