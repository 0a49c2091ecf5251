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
from safetensors.numpy import load_file

from torchrl_koap.evaluation.latent_verdict import MODELS, OUTSIDE_THE_BUDGET, error_unit
from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.spectrum_plot import as_spectrum, draw_spectrum
from torchrl_koap.reports.style import (
    BLUE,
    FAINT,
    INK,
    MUTED,
    ORANGE,
    PALE_BLUE,
    WARNING,
    as_array,
    legend_beside,
    save_figure,
    set_title,
    tidy,
)
from torchrl_koap.tasks import Task, get_task

_BLOWN_UP = 1e6  # in the unit shown; a prediction further off is left out of the picture
_LABELS = {
    "koopman": ("latent dynamics", BLUE),
    "reconstruction": ("lifted and mapped back", PALE_BLUE),
    "linear": ("linear model on raw states", ORANGE),
    "copy_last": ("standing still", MUTED),
}


@picture(
    "latent.png",
    source="inspect.json",
    title="What the latent space holds",
    caption="Left: eigenvalues of the operator. Middle: errors of predicted states, latent actions given; a test of the"
    " models, not a forecast. Right, for analysis only: how much of the true actions a linear probe on labels"
    " outside the budget, and the run's own decoder, explain on held-out demonstrations.",
    place=60,
)
def _draw_latent(result: Mapping[str, Any], path: Path, *, task: str | None, run_dir: Path) -> Path:
    latent, values = result.get("latent", {}), run_dir / "eigenvalues.safetensors"
    if "multi_step" not in latent or task is None:
        raise NothingToDraw("no latent space was looked into")
    parts = load_file(values) if values.exists() and "eigenvalues" in latent else None
    spectrum = None if parts is None else parts["real"] + 1j * parts["imag"]
    return plot_latent(latent, path, task=get_task(task), eigenvalues=spectrum)


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
        >>> from torchrl_koap.evaluation.latent_verdict import MODELS, OUTSIDE_THE_BUDGET
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
    panels = (["spectrum"] if eigenvalues is not None else []) + ["errors"] + ([] if "note" in outside else ["probe"])
    figure = Figure(figsize=(4.6 * len(panels) + 0.8, 4.1), layout="constrained")
    axes = dict(zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True))
    if eigenvalues is not None:
        values = as_array("eigenvalues", eigenvalues, [None])
        draw_spectrum(axes["spectrum"], as_spectrum(values.real, values.imag))
    _draw_errors(axes["errors"], latent["multi_step"], task)
    if "probe" in axes:
        _draw_probe(axes["probe"], outside, list(task.action_names))
    if "note" in outside:
        return save_figure(figure, path)
    shared = outside.get("judged_trajectories_in_budget")
    inside = bool(shared) and shared == outside.get("judged_trajectories")
    which = "of the budget, which the decoder has seen" if inside else "outside the budget"
    figure.suptitle(
        f"probe and decoder: for analysis only, reads {outside['labels_read']:,} labels, {which}",
        fontsize=10,
        color=WARNING,
        x=0.99,
        ha="right",
    )
    return save_figure(figure, path)


def _draw_errors(axes: Axes, errors: Mapping[str, Any], task: Task) -> None:
    part = next(iter(errors["koopman"]))
    shown, factor = error_unit(part, task)
    steps = np.arange(1, errors["steps"] + 1)
    for model in MODELS:
        values = factor * np.asarray(errors[model][part], dtype=float)
        label, color = _LABELS[model]
        axes.plot(steps, np.where((values > 0) & (values < _BLOWN_UP), values, np.nan), ".-", color=color, label=label)
    axes.set_yscale("log")
    axes.margins(y=0.1)
    axes.set_xlabel(f"control steps ahead, {1e3 / task.control_hz:.0f} ms each\n(latent actions given)")
    axes.set_ylabel(f"root mean square distance ({shown})" if shown else "root mean square distance")
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    axes.grid(axis="y", which="major", color=FAINT, linewidth=0.5)
    judged = f"on {errors['judged_trajectories']} demonstrations"
    set_title(axes, f"Error of the predicted {part.replace('_', ' ')}\n{judged}")
    axes.legend(frameon=False, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2)
    tidy(axes)


def _draw_probe(axes: Axes, outside: Mapping[str, Any], names: list[str]) -> None:
    places = np.arange(len(names))
    for offset, key, color, label in (
        (-0.19, "probe_r2", PALE_BLUE, "linear probe, all labels of half"),
        (0.19, "decoder_r2", BLUE, "the run's decoder"),
    ):
        values = np.asarray(outside[key], dtype=float)
        axes.bar(places + offset, np.clip(values, 0, None), width=0.36, color=color, label=label)
        for place, value in zip(places + offset, values, strict=True):
            if np.isfinite(value):
                style = {"ha": "center", "fontsize": 7, "color": INK, "rotation": 90 if len(names) > 4 else 0}
                axes.annotate(f"{value:.3f}", (place, max(value, 0) + 0.01), **style)
    axes.set_ylim(0, 1.12)
    axes.set_xticks(places, names, fontsize=8, rotation=45 if len(names) > 4 else 0)
    axes.set_yticks((0, 0.25, 0.5, 0.75, 1))
    axes.set_ylabel("share of variance explained (R²)")
    set_title(axes, "True actions from latent actions\non the same held-out demonstrations")
    legend_beside(axes, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2, columnspacing=1)
    tidy(axes)
