# This source code is licensed under the MIT license found in the LICENSE file.
"""Charts of training and controller: losses, eigenvalues, predicted actions.

Every function takes plain tensors or arrays and a file, draws into a figure of its own (no pyplot, no global state),
writes aside, renames, and returns the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_koap.reports.pictures import picture
from torchrl_koap.reports.spectrum_plot import as_spectrum, draw_distances, draw_spectrum
from torchrl_koap.reports.style import (
    BLUE,
    FAINT,
    MUTED,
    SERIES,
    WARNING,
    as_array,
    legend_beside,
    save_figure,
    set_title,
    thousandths,
    tidy,
)

_ROUND = (1, 2, 5, 10)
TERMS = {
    "loss_planner": "planner",
    "loss_reconstruction": "reconstruction",
    "loss_koopman": "linear latent dynamics",
    "loss_action": "action decoder (labelled steps)",
}


@picture(
    "losses.png",
    source="metrics.csv",
    title="Losses",
    caption="Pale: logged values; line: running mean, its last value in the corner. Logarithmic. A planner's loss says"
    " little about its rollouts: judge it by the pictures above.",
    place=100,
)
def _draw_losses(rows: Sequence[Mapping[str, str]], path: Path) -> Path:
    if not rows:
        raise ValueError("no row has been logged yet")
    columns = {}
    for name in rows[0]:
        if name == "step" or (name or "").startswith("loss_"):
            columns[name] = [float(row[name]) if row[name] else np.nan for row in rows]
    return plot_losses(columns, path)


def plot_losses(metrics: Mapping[str, Sequence[float]], path: str | Path) -> Path:
    """Loss curves, a panel per term, logarithmic; raw values pale, a running mean on top.

    Args:
        metrics (mapping): columns of ``metrics.csv``: ``step`` and any number of ``loss_*``, all of the same length;
            NaN where a term does not belong to the row.
        path (str or Path): png to write.

    Raises:
        ValueError: if ``step`` or every loss is missing, or lengths differ.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.training_plots import plot_losses
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_losses({"step": [0, 1, 2], "loss_planner": [1.0, 0.5, 0.4]}, f"{folder}/losses.png").name
        'losses.png'
    """
    if "step" not in metrics:
        raise ValueError(f"metrics need the column 'step', got {', '.join(metrics) or 'none'}")
    step = as_array("step", metrics["step"], [None]).astype(float)
    known = [name for name in TERMS if name in metrics]
    names = known + sorted(name for name in metrics if name.startswith("loss_") and name not in TERMS)
    columns = {name: as_array(name, metrics[name], [len(step)]).astype(float) for name in names}
    columns = {name: values for name, values in columns.items() if np.isfinite(values).any()}
    if not columns:
        raise ValueError(f"metrics hold no value of any loss_* column, got the columns {', '.join(metrics)}")

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
            last = smooth[np.isfinite(smooth)][-1]
            axes.plot(x, y, color=BLUE, alpha=0.25, linewidth=0.7)
            axes.plot(x, smooth, color=BLUE, linewidth=1.6)
            axes.set_yscale("log")
            low, high = np.nanmin(y), np.nanmax(y)
            widen = max(1.0, 4 * low / high) ** 0.5  # a flat curve looks flat
            axes.set_ylim(low / widen / 1.15, high * widen * 1.15)
            axes.grid(axis="y", which="major", color=FAINT, linewidth=0.5)
            axes.annotate(
                f"{last:.3g}", (1, 0.97), xycoords="axes fraction", ha="right", va="top", fontsize=9, color=BLUE
            )
        else:
            axes.text(
                0.5, 0.5, "0 throughout: no label entered this loss", transform=axes.transAxes, ha="center", color=MUTED
            )
            axes.set_yticks([])
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True, steps=_ROUND))
        tidy(axes)
    return save_figure(figure, path)


def running_mean(values: np.ndarray, reach: int) -> np.ndarray:
    """Mean of the values at most ``reach`` places away, leaving out NaN; shorter windows at both ends.

    Args:
        values (np.ndarray): numbers [N].
        reach (int): places to either side.

    Returns:
        np.ndarray: means [N]; NaN where there is nothing to average.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.reports.training_plots import running_mean
        >>> running_mean(np.array([0.0, 3.0, 6.0]), 1).tolist()
        [1.5, 3.0, 4.5]
    """
    there = np.isfinite(values)
    ahead = np.arange(len(values)) + reach + 1
    first, last = np.maximum(ahead - 2 * reach - 1, 0), np.minimum(ahead, len(values))
    total = np.concatenate([[0.0], np.cumsum(np.where(there, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(there)])
    number = count[last] - count[first]
    return np.where(number > 0, (total[last] - total[first]) / np.maximum(number, 1), np.nan)


@picture(
    "eigenvalues.png",
    source="eigenvalues.safetensors",
    title="Koopman eigenvalues",
    caption="Left: eigenvalues of the latent operator in the complex plane; orange ones lie outside the unit circle,"
    " where predictions grow, pale ones on it within a thousandth. Right: how far each lies from the circle, on an axis"
    " that is linear within a thousandth of it and logarithmic beyond, with the time in which such a part of the state"
    " fades.",
    place=110,
)
def _draw_eigenvalues(values: Mapping[str, Any], path: Path, *, control_hz: float | None) -> Path:
    return plot_eigenvalues(values["real"], values["imag"], path, control_hz=control_hz)


def plot_eigenvalues(real: Any, imag: Any, path: str | Path, *, control_hz: float | None = None) -> Path:
    """Eigenvalues of the Koopman operator in the complex plane, and how far each lies from the unit circle.

    Args:
        real (torch.Tensor or array): real parts [m].
        imag (torch.Tensor or array): imaginary parts [m].
        path (str or Path): png to write.
        control_hz (float, optional): control steps per second; adds the time in which a mode fades to 1/e.

    Raises:
        ValueError: if there is none, or one is not finite.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.training_plots import plot_eigenvalues
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_eigenvalues([0.9, 0.5], [0.1, 0.0], f"{folder}/eigenvalues.png").name
        'eigenvalues.png'
    """
    values = as_spectrum(real, imag)
    figure = Figure(figsize=(9.4, 4.2), layout="constrained")
    plane, rank = figure.subplots(1, 2, width_ratios=(1, 1.15))
    draw_spectrum(plane, values)
    draw_distances(rank, values, control_hz=control_hz)
    return save_figure(figure, path)


@picture(
    "actions.png",
    source="actions.safetensors",
    title="Predicted against recorded actions",
    caption="For analysis only: the recorded actions of unlabelled demonstrations lie outside the label budget and were"
    " not used for training or selection. Points on the diagonal are exact; a slope below 1 means timid actions, an"
    " offset in the error histogram means drift.",
    place=90,
)
def _draw_actions(data: Mapping[str, Any], path: Path, *, actions: Sequence[tuple[str, str, bool]] | None) -> Path:
    if not actions or len(actions) != data["true"].shape[-1]:
        return plot_actions(data["predicted"], data["true"], path)
    names, units, _ = zip(*actions, strict=True)
    levels = [name for name, _, level in actions if level]  # a number that is set, not a change per step
    return plot_actions(data["predicted"], data["true"], path, names=names, units=units, absolute=levels)


def plot_actions(
    predicted: Any,
    true: Any,
    path: str | Path,
    *,
    names: Sequence[str] | None = None,
    units: Sequence[str] | None = None,
    absolute: Sequence[str] = (),
) -> Path:
    """Predicted against recorded actions, a panel per dimension, and the distribution of the errors.

    The recorded actions are those of unlabelled demonstrations: reading them spends labels outside the budget, which
    only an analysis may do. The title says so.

    Args:
        predicted (torch.Tensor or array): actions the controller gives [N, d].
        true (torch.Tensor or array): recorded actions [N, d].
        path (str or Path): png to write.
        names (sequence of str, optional): name of each column. Default: numbers.
        units (sequence of str, optional): unit of each column in the data, ``""`` for none; metres, radians, seconds
            and newtons are shown in thousandths.
        absolute (sequence of str): columns that are no change per step, by name. They, and columns of another unit
            than the first, are left out of the distribution of the errors.

    Raises:
        ValueError: if shapes differ, names or units are not one per column, or no row is finite in both.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.reports.training_plots import plot_actions
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_actions(torch.zeros(5, 2), torch.full((5, 2), 1e-3), f"{folder}/actions.png").name
        'actions.png'
    """
    true = as_array("true", true, [None, None])
    predicted = as_array("predicted", predicted, true.shape)
    width = true.shape[1]
    names = [f"action {index + 1}" for index in range(width)] if names is None else list(names)
    units = [""] * width if units is None else list(units)
    for what, given in (("names", names), ("units", units)):
        if len(given) != width:
            raise ValueError(f"{what!r} must be one per action column, {width} in all, got {len(given)}")
    there = np.isfinite(true).all(1) & np.isfinite(predicted).all(1)
    if not there.any():
        raise ValueError(f"'predicted' and 'true' have no row of {len(true)} that is finite in both")
    shown, factor = zip(*map(thousandths, units), strict=True)
    true, predicted = true[there] * factor, predicted[there] * factor
    error = predicted - true
    across = width + 1 if width < 5 else -(-(width + 1) // 2)
    down = -(-(width + 1) // across)
    figure = Figure(figsize=(3.2 * across + 0.6, 3.4 * down + 0.35), layout="constrained")
    for index, name in enumerate(names):
        axes = figure.add_subplot(down, across, index + 1)
        _scatter(axes, true[:, index], predicted[:, index])
        each = " ".join(filter(None, (shown[index], "" if name in absolute else "per step")))
        axes.set_xlabel(f"recorded {name} ({each})" if each else f"recorded {name}")
        axes.set_ylabel(f"predicted {name} ({each})" if each else f"predicted {name}")
        set_title(axes, f"{name}: RMSE {_rms(error[:, index]):.3g} {shown[index]}".rstrip())
    same = [n for n in range(width) if names[n] not in absolute and units[n] == units[0]] or list(range(width))
    left_out = [names[index] for index in range(width) if index not in same]
    axes = figure.add_subplot(down, across, width + 1)
    _histogram(axes, error[:, same], [names[index] for index in same], shown[same[0]], left_out)
    title = f"{len(true):,} steps of unlabelled demonstrations - for analysis only: reads labels outside the budget"
    figure.suptitle(title, fontsize=10, color=WARNING, x=0.01, ha="left")
    return save_figure(figure, path)


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


def _histogram(axes: Axes, error: np.ndarray, names: Sequence[str], unit: str, left_out: Sequence[str]) -> None:
    reach = max(float(np.quantile(abs(error), 0.995)), 1e-9)
    for column, name in enumerate(names):
        style = {"histtype": "step", "color": SERIES[column % len(SERIES)], "linewidth": 1.4, "label": name}
        axes.hist(np.clip(error[:, column], -reach, reach), bins=41, range=(-reach, reach), **style)
    which = f"all but {', '.join(left_out)}" if left_out else "all"
    size = f"RMSE {_rms(error):.3g} {unit}".rstrip()
    set_title(axes, f"{which}: {size}, median {np.median(abs(error)):.2g}")
    axes.set_box_aspect(1)
    axes.set_xlabel(f"predicted - recorded ({unit})" if unit else "predicted - recorded")
    axes.set_ylabel("steps")
    legend_beside(axes)
    tidy(axes)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))
