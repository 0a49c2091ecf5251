# This source code is licensed under the MIT license found in the LICENSE file.
"""Picture of what `koap inspect` finds in the latent space: spectrum, multi-step errors, linear probe."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_koap.evaluation.latent_space import MODELS, OUTSIDE_THE_BUDGET, error_unit
from torchrl_koap.reports.scenes import FAINT, INK, MUTED, set_title, tidy
from torchrl_koap.reports.training_plots import BLUE, ORANGE, as_array, save_figure
from torchrl_koap.tasks import Task

_WARNING = "#9a3412"
_BLOWN_UP = 1e6  # mm; a prediction further off is left out of the picture
_LABELS = {
    "koopman": ("latent dynamics", BLUE),
    "reconstruction": ("lifted and mapped back", "#9cc3f5"),
    "linear": ("linear model on raw states", ORANGE),
    "copy_last": ("standing still", MUTED),
}


def plot_latent(latent: Mapping[str, Any], path: str | Path, *, task: Task, eigenvalues: Any = None) -> Path:
    """Eigenvalues in the unit circle, errors per horizon, and how much of the true actions lies in the latent ones.

    Args:
        latent (mapping): result of :func:`~torchrl_koap.evaluation.latent_space.analyse_latent`.
        path (str or Path): png to write.

    Keyword Args:
        task (Task): the task, for names and units.
        eigenvalues (Tensor, optional): complex ``[m]``; the first panel is left out without.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.evaluation.latent_space import MODELS, OUTSIDE_THE_BUDGET, error_unit
        >>> from torchrl_koap.reports.latent_plot import plot_latent
        >>> from torchrl_koap.tasks import get_task
        >>> errors = {name: {"measured_xy": [0.001, 0.002]} for name in MODELS}
        >>> outside = {"probe_r2": [0.9, 0.8], "decoder_r2": [0.7, 0.6], "labels_read": 50}
        >>> latent = {"multi_step": errors | {"steps": 2, "judged_trajectories": 3}, OUTSIDE_THE_BUDGET: outside}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_latent(latent, f"{folder}/latent.png", task=get_task("avoiding")).name
        'latent.png'
    """
    outside = latent[OUTSIDE_THE_BUDGET]
    panels = (["spectrum"] if eigenvalues is not None else []) + ["errors", "probe"]
    figure = Figure(figsize=(4.1 * len(panels), 3.9), layout="constrained")
    axes = dict(zip(panels, figure.subplots(1, len(panels)), strict=True))
    if eigenvalues is not None:
        _draw_spectrum(axes["spectrum"], as_array("eigenvalues", eigenvalues, [None]), latent["eigenvalues"])
    _draw_errors(axes["errors"], latent["multi_step"], task)
    _draw_probe(axes["probe"], outside, action_names(task))
    figure.suptitle(
        f"probe and decoder: for analysis only, reads {outside['labels_read']:,} labels, outside the budget",
        fontsize=10,
        color=_WARNING,
        x=0.99,
        ha="right",
    )
    return save_figure(figure, path)


def action_names(task: Task) -> list[str]:
    """Short names of the action entries of a task.

    Examples:
        >>> from torchrl_koap.reports.latent_plot import action_names
        >>> from torchrl_koap.tasks import get_task
        >>> action_names(get_task("aligning")), action_names(get_task("stacking"))[-2:]
        (['x', 'y', 'z'], ['joint 7', 'gripper'])
    """
    return list(task.action_names)


def _draw_spectrum(axes: Axes, values: np.ndarray, facts: Mapping[str, Any]) -> None:
    angle = np.linspace(0, 2 * np.pi, 400)
    axes.fill(np.cos(angle), np.sin(angle), color="#f4f5f7", zorder=0)
    axes.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=1)
    axes.axhline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    axes.axvline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    panels = [axes]
    centre = np.array([values.real.min() + values.real.max(), values.imag.min() + values.imag.max()]) / 2
    spread = max(np.ptp(values.real), np.ptp(values.imag), 0.02)
    if spread < 0.4 and values.real.min() > 0.25:  # the empty half has room for a closer look
        inset = axes.inset_axes((0.2, 0.55, 0.33, 0.33))
        inset.set(xlim=centre[0] + 0.6 * spread * np.array([-1, 1]), ylim=centre[1] + 0.6 * spread * np.array([-1, 1]))
        inset.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=1)
        inset.tick_params(labelsize=6.5, color=FAINT, labelcolor=MUTED)
        inset.locator_params(nbins=3)
        axes.indicate_inset_zoom(inset, edgecolor=MUTED)
        panels.append(inset)
    for panel in panels:
        panel.scatter(values.real, values.imag, s=20, color=BLUE, alpha=0.6, linewidths=0, zorder=2)
    reach = 1.1 * min(max(1.0, float(np.abs(values).max())), 4.0)  # the title counts those beyond
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1, xlabel="real part", ylabel="imaginary part")
    counts = f"{facts['inside']} inside, {facts['on']} on, {facts['outside']} outside the circle"
    set_title(axes, f"Eigenvalues, radius {facts['spectral_radius']:.5g}\n{counts}")
    tidy(axes)


def _draw_errors(axes: Axes, errors: Mapping[str, Any], task: Task) -> None:
    part = next(iter(errors["koopman"]))
    steps = np.arange(1, errors["steps"] + 1)
    for model in MODELS:
        values = 1e3 * np.asarray(errors[model][part], dtype=float)
        label, color = _LABELS[model]
        axes.plot(steps, np.where((values > 0) & (values < _BLOWN_UP), values, np.nan), ".-", color=color, label=label)
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.45)  # room for the legend
    axes.set_xlabel(f"control steps ahead (latent actions given; {1e3 / task.control_hz:.0f} ms each)")
    axes.set_ylabel(f"root mean square distance ({error_unit(part)})")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.grid(axis="y", which="major", color=FAINT, linewidth=0.5)
    judged = f"on {errors['judged_trajectories']} demonstrations"
    set_title(axes, f"Error of the predicted {part.replace('_', ' ')}\n{judged}")
    axes.legend(frameon=False, fontsize=8)
    tidy(axes)


def _draw_probe(axes: Axes, outside: Mapping[str, Any], names: list[str]) -> None:
    places = np.arange(len(names))
    for offset, key, color, label in (
        (-0.19, "probe_r2", "#9cc3f5", "linear probe, all labels of half"),
        (0.19, "decoder_r2", BLUE, "the run's decoder"),
    ):
        values = np.asarray(outside[key], dtype=float)
        axes.bar(places + offset, np.clip(values, 0, None), width=0.36, color=color, label=label)
        for place, value in zip(places + offset, values, strict=True):
            if np.isfinite(value):
                style = {"ha": "center", "fontsize": 7, "color": INK, "rotation": 90 if len(names) > 4 else 0}
                axes.annotate(f"{value:.3f}", (place, max(value, 0) + 0.01), **style)
    axes.set_ylim(0, 1.3)
    axes.set_xticks(places, names, fontsize=8, rotation=45 if len(names) > 4 else 0)
    axes.set_yticks((0, 0.25, 0.5, 0.75, 1))
    axes.set_ylabel("share of variance explained (R²)")
    set_title(axes, "True actions from latent actions\non the same held-out demonstrations")
    axes.legend(frameon=False, fontsize=8, loc="upper left", ncols=2, columnspacing=1)
    tidy(axes)
