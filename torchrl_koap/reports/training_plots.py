# This source code is licensed under the MIT license found in the LICENSE file.
"""Charts of training and controller; paths are in ``path_plots``, modes in ``mode_plots``.

Every function takes plain tensors or arrays and a file, draws into a figure of its own (no pyplot, no global state),
writes aside, renames, and returns the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_koap.reports.scenes import BLUE, FAINT, GREEN, INK, MUTED, set_title, tidy

ORANGE = "#d9730d"
_SERIES = (BLUE, ORANGE, GREEN, "#8250df", "#bf3989", "#0a7f7f", "#6b7280")
_ROUND = (1, 2, 5, 10)
TERMS = {
    "loss_planner": "planner",
    "loss_reconstruction": "reconstruction",
    "loss_koopman": "linear latent dynamics",
    "loss_action": "action decoder (labelled steps)",
}


def as_array(name: str, value: Any, shape: Sequence[int | None]) -> np.ndarray:
    """Turns a tensor or array into a numpy array and checks its shape.

    Args:
        name (str): name used in the message.
        value (torch.Tensor or array): what was handed in; on any device, with or without gradient.
        shape (sequence): wanted sizes, None where any size will do.

    Raises:
        ValueError: if the shape is another one.

    Examples:
        >>> import torch
        >>> from torchrl_koap.reports.training_plots import as_array
        >>> as_array("real", torch.ones(3), [None]).tolist()
        [1.0, 1.0, 1.0]
    """
    if hasattr(value, "detach"):  # a tensor; torch itself is not imported, that takes seconds
        value = value.detach().cpu().numpy()
    value = np.asarray(value)
    if value.ndim != len(shape) or any(w is not None and w != g for w, g in zip(shape, value.shape, strict=False)):
        wanted = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name!r} must have shape [{wanted}], got {list(value.shape)}")
    return value


def save_figure(figure: Figure, path: str | Path, *, dpi: int = 150) -> Path:
    """Writes a figure as png, aside first, so that an earlier picture is replaced whole or not at all."""
    from torchrl_koap.files import replacing_file  # imports torch: only when something is written

    path = Path(path)
    with replacing_file(path) as aside:
        figure.savefig(aside, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    return path


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


def plot_eigenvalues(real: Any, imag: Any, path: str | Path, *, control_hz: float | None = None) -> Path:
    """Eigenvalues of the Koopman operator in the unit circle, and their magnitudes in order.

    Args:
        real (torch.Tensor or array): real parts [m].
        imag (torch.Tensor or array): imaginary parts [m].
        path (str or Path): png to write.
        control_hz (float, optional): control steps per second; adds the time in which a mode fades to 1/e.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.reports.training_plots import plot_eigenvalues
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_eigenvalues([0.9, 0.5], [0.1, 0.0], f"{folder}/eigenvalues.png").name
        'eigenvalues.png'
    """
    real = as_array("real", real, [None])
    imag = as_array("imag", imag, [len(real)])
    size = np.hypot(real, imag)
    if not len(size) or not np.isfinite(size).all():
        raise ValueError(f"eigenvalues must be finite and at least one, got {len(size)} with NaN or infinite ones")
    outside = size > 1 + 1e-6
    figure = Figure(figsize=(8.4, 4.1), layout="constrained")
    plane, rank = figure.subplots(1, 2, width_ratios=(1, 1.05))

    angle = np.linspace(0, 2 * np.pi, 400)
    plane.fill(np.cos(angle), np.sin(angle), color="#f4f5f7", zorder=0)
    plane.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=1, zorder=1)
    plane.axhline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    plane.axvline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    reach = 1.1 * max(1.0, float(size.max()))
    plane.set_xlim(-reach, reach)
    plane.set_ylim(-reach, reach)
    plane.set_box_aspect(1)
    rank.set_box_aspect(1)
    plane.set_xticks((-1, -0.5, 0, 0.5, 1))
    plane.set_yticks((-1, -0.5, 0, 0.5, 1))
    plane.set_xlabel("real part")
    plane.set_ylabel("imaginary part")
    set_title(plane, f"{len(size)} eigenvalues, {int(outside.sum())} outside the unit circle")

    order = np.argsort(-size)
    rank.axhline(1, color=MUTED, linewidth=1)
    rank.set_xlabel("rank")
    rank.set_ylabel("magnitude")
    set_title(rank, f"largest magnitude {size.max():.4f}")
    low, high = max(0.0, size.min() - 0.02), max(1.0, size.max()) + 0.02
    rank.set_ylim(low - 0.05 * (high - low) if low else 0, high + 0.05 * (high - low))
    panels = [plane]
    spread = max(np.ptp(real), np.ptp(imag), 0.02)
    if spread < 0.4 and real.min() > 0.25:  # the empty half has room for a closer look
        inset = plane.inset_axes((0.1, 0.53, 0.35, 0.35))
        centre = np.array([real.min() + real.max(), imag.min() + imag.max()]) / 2
        inset.set_xlim(centre[0] - 0.6 * spread, centre[0] + 0.6 * spread)
        inset.set_ylim(centre[1] - 0.6 * spread, centre[1] + 0.6 * spread)
        inset.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=1, zorder=1)
        inset.tick_params(labelsize=6.5, color=FAINT, labelcolor=MUTED)
        inset.locator_params(nbins=3)
        plane.indicate_inset_zoom(inset, edgecolor=MUTED)
        panels.append(inset)
    ranks = np.arange(1, len(size) + 1)
    for subset, color in ((~outside, BLUE), (outside, ORANGE)):
        style = {"s": 20, "color": color, "alpha": 0.6, "linewidths": 0}
        for axes in panels:
            axes.scatter(real[subset], imag[subset], zorder=2, **style)
        rank.scatter(ranks[subset[order]], size[order][subset[order]], **style)
    tidy(plane), tidy(rank)
    if control_hz is not None:
        bottom, top = rank.get_ylim()
        ticks: dict[float, str] = {}
        for time in (0.01, 0.03, 0.1, 0.3, 1, 3, 10):
            place = math.exp(-1 / (time * control_hz))
            if place > max([bottom, *(tick + 0.045 * (top - bottom) for tick in ticks)]):  # labels need room
                ticks[place] = f"{time:g} s"
        fades = rank.secondary_yaxis("right")
        fades.set_yticks(list(ticks), list(ticks.values()))
        fades.tick_params(labelsize=8, color=FAINT, labelcolor=MUTED)
        fades.set_ylabel("fades to 1/e within", size=9, color=INK)
        fades.spines["right"].set_visible(False)
    return save_figure(figure, path)


def plot_actions(
    predicted: Any,
    true: Any,
    path: str | Path,
    *,
    names: Sequence[str] = ("x", "y"),
    scale: float = 1e3,
    unit: str = "mm",
    absolute: Mapping[str, str] | None = None,
) -> Path:
    """Predicted against recorded actions, a panel per dimension, and the distribution of the errors.

    The recorded actions are those of unlabelled demonstrations: reading them spends labels outside the budget, which
    only an analysis may do. The title says so.

    Args:
        predicted (torch.Tensor or array): actions the controller gives [N, d].
        true (torch.Tensor or array): recorded actions [N, d].
        path (str or Path): png to write.
        names (sequence of str): name of each dimension.
        scale (float): factor from the unit of the data (m or rad per step) to the unit shown.
        unit (str): the unit shown.
        absolute (mapping, optional): dimensions that are no change per step, by name, with the unit shown. They are
            left out of the distribution of the errors.

    Raises:
        ValueError: if shapes differ, or no row is finite in both.

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
    there = np.isfinite(true).all(1) & np.isfinite(predicted).all(1)
    if not there.any():
        raise ValueError(f"'predicted' and 'true' have no row of {len(true)} that is finite in both")
    true, predicted = scale * true[there], scale * predicted[there]
    error = predicted - true
    width = true.shape[1]
    names = [names[index] if index < len(names) else str(index) for index in range(width)]
    absolute = absolute or {}
    across = width + 1 if width < 5 else -(-(width + 1) // 2)
    down = -(-(width + 1) // across)
    figure = Figure(figsize=(3.2 * across, 3.4 * down + 0.35), layout="constrained")
    for index, name in enumerate(names):
        axes = figure.add_subplot(down, across, index + 1)
        low, high = np.quantile(np.concatenate([true[:, index], predicted[:, index]]), [0.0005, 0.9995])
        margin = 0.06 * (high - low) + 1e-9
        span = (low - margin, high + margin)
        axes.plot(span, span, color=MUTED, linewidth=0.8, zorder=1)
        size = float(np.clip(3000 / len(true), 1.5, 14))
        opacity = float(np.clip(600 / len(true), 0.12, 0.7))
        axes.scatter(true[:, index], predicted[:, index], s=size, color=BLUE, alpha=opacity, linewidths=0, zorder=2)
        shown = absolute.get(name, f"{unit} per step")
        axes.set(xlim=span, ylim=span, box_aspect=1, xlabel=f"recorded {name} ({shown})")
        axes.set_ylabel(f"predicted {name} ({shown})")
        set_title(axes, f"{name}: RMSE {_rms(error[:, index]):.2f} {absolute.get(name, unit)}")
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=_ROUND))
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=_ROUND))
        tidy(axes)
    axes = figure.add_subplot(down, across, width + 1)
    same = [index for index, name in enumerate(names) if name not in absolute] or list(range(width))
    error = error[:, same]
    reach = max(float(np.quantile(abs(error), 0.995)), 1e-9)
    for column, index in enumerate(same):
        style = {"histtype": "step", "color": _SERIES[column % len(_SERIES)], "linewidth": 1.4, "label": names[index]}
        axes.hist(np.clip(error[:, column], -reach, reach), bins=41, range=(-reach, reach), **style)
    which = "all" if len(same) == width else f"all but {', '.join(absolute)}"
    set_title(axes, f"{which}: RMSE {_rms(error):.2f} {unit}, median {np.median(abs(error)):.2f}")
    axes.set_box_aspect(1)
    axes.set_xlabel(f"predicted - recorded ({unit} per step)")
    axes.set_ylabel("steps")
    axes.legend(frameon=False, fontsize=9 if len(same) < 5 else 7)
    tidy(axes)
    title = f"{len(true):,} steps of unlabelled demonstrations - for analysis only: reads labels outside the budget"
    figure.suptitle(title, fontsize=10, color="#9a3412", x=0.01, ha="left")
    return save_figure(figure, path)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.square(values).mean()))
