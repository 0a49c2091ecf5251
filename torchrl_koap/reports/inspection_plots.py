# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws what a controller has learnt: its spectrum, its latent space, and which part of the run fails."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from torchrl_koap.evaluation.findings import OUTSIDE_THE_BUDGET, error_unit
from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.style import (
    BLUE,
    FAINT,
    INK,
    MUTED,
    ORANGE,
    PALE,
    PALE_BLUE,
    WARNING,
    put_legend,
    shorten,
    tidy,
)
from torchrl_koap.tasks import Task

ON_THE_CIRCLE = 1e-3  # eigenvalues with a magnitude this near to 1 count as on the unit circle
_SIDES = {"inside": BLUE, "on": PALE_BLUE, "outside": ORANGE}
_EXPERIMENTS = {
    "planner_alone": "planner alone\n(exactly executed plans)",
    "controller_alone": "controller alone\n(recorded states)",
    "both": "both\n(closed loop)",
}
_DIVERGED = 1e6  # in the displayed unit; larger errors are not drawn
_MODELS = {
    "koopman": ("latent dynamics", BLUE),
    "reconstruction": ("lifted and mapped back", PALE_BLUE),
    "linear": ("linear model on raw states", ORANGE),
    "copy_last": ("standing still", MUTED),
}


@picture(
    "latent.png",
    source="inspect.json",
    title="What the latent space holds",
    caption="Left: eigenvalues of the Koopman operator, which predicts the lifted state. Orange ones lie outside the"
    " unit circle, where predictions grow; pale ones lie on it within a thousandth. Middle: errors of predicted states"
    " if the latent actions are known. Right, for evaluation only: the share of the true actions that is explained on"
    " held-out demonstrations, by a linear map fitted to all labels (probe) and by the run's own decoder.",
    order=60,
)
def draw_latent(result: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws eigenvalues, errors per horizon, and how well latent actions explain true ones."""
    latent = result.get("latent", {})
    if "multi_step" not in latent or run.task is None:
        raise NothingToDraw("no latent space was inspected")
    outside = latent[OUTSIDE_THE_BUDGET]
    panels = ["spectrum", "errors"] + ["probe"] * ("note" not in outside)
    figure = Figure(figsize=(4.6 * len(panels) + 0.8, 4.1), layout="constrained")
    axes = dict(zip(panels, figure.subplots(1, len(panels), squeeze=False)[0], strict=True))
    _draw_plane(
        axes["spectrum"], np.array(latent["eigenvalues"]["real"]) + 1j * np.array(latent["eigenvalues"]["imag"])
    )
    _draw_errors(axes["errors"], latent["multi_step"], run.task)
    if "probe" in axes:
        _draw_probe(axes["probe"], outside, list(run.task.actions))
        inside = outside.get("held_out_in_budget") == outside["held_out_trajectories"]
        which = "of the budget, which the decoder has seen" if inside else "also outside the budget"
        head = f"probe and decoder: for evaluation only, reads {outside['labels_read']:,} labels, {which}"
        figure.suptitle(head, fontsize=10, color=WARNING, x=0.99, ha="right")
    return figure


@picture(
    "inspect.png",
    source="inspect.json",
    title="Which part fails",
    caption="Success of the planner if its plans are executed exactly, of the controller on recorded states, and of"
    " both in closed loop; distances of executed states to plans.",
    order=70,
)
def draw_experiments(result: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws success of planner, controller and both, and distances of executed states from plans by state part."""
    if "both" not in result:
        raise NothingToDraw("the experiments in the simulator were left out")
    figure = Figure(figsize=(9.8, 4.1), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 1.3))
    made = {name: words for name, words in _EXPERIMENTS.items() if name in result}
    for index, name in enumerate(made):
        value = result[name]
        left.bar(index, 100 * value["rate"], width=0.6, color=BLUE if name == "both" else PALE_BLUE)
        left.vlines(index, 100 * value["low"], 100 * value["high"], color=INK, linewidth=1.4)
    numbers = [f"{words}\nn = {result[name]['episodes']}" for name, words in made.items()]
    left.set_xticks(range(len(made)), numbers, fontsize=8)
    left.set_ylim(0, 105)
    left.set_ylabel("success (%)")
    tidy(left, "Success of the parts (95 % intervals)")
    for key, color, offset, label in (
        ("plan_to_execution", ORANGE, 0.18, "from the plan"),
        ("recording_to_execution", MUTED, -0.18, "from the recording, when that is the plan"),
    ):
        values = [errors[-1] for errors in result.get(key, {}).values()]
        right.barh(np.arange(len(values)) + offset, values, height=0.34, color=color, label=label if values else None)
    names = list(result["plan_to_execution"])
    right.set_yticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=8)
    right.invert_yaxis()
    right.set_xlabel("root mean square distance after the last step of a plan")
    if names:
        put_legend(right, below=0.24)
    tidy(right, "Distance of execution")
    return figure


def _draw_plane(axes: Axes, values: np.ndarray) -> None:
    """Draws eigenvalues in the complex plane; an inset magnifies them if they are close together."""
    angle = np.linspace(0, 2 * np.pi, 2000)
    size = np.abs(values)
    side = np.where(size > 1 + ON_THE_CIRCLE, "outside", np.where(size < 1 - ON_THE_CIRCLE, "inside", "on"))
    axes.fill(np.cos(angle), np.sin(angle), color=PALE, zorder=0)
    axes.axhline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    axes.axvline(0, color=FAINT, linewidth=0.6, zorder=0.5)
    reach = 1.1 * min(max(1.0, float(size.max())), 4.0)  # the title counts those beyond
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), box_aspect=1, xlabel="real part", ylabel="imaginary part")
    if reach < 2:
        axes.set(xticks=(-1, -0.5, 0, 0.5, 1), yticks=(-1, -0.5, 0, 0.5, 1))
    panels = [axes]
    centre = np.array([values.real.min() + values.real.max(), values.imag.min() + values.imag.max()]) / 2
    spread = max(np.ptp(values.real), np.ptp(values.imag), 0.002)
    if spread < 0.4 and values.real.min() > 0.25:  # the inset covers the empty left half
        inset = axes.inset_axes((0.17, 0.54, 0.36, 0.36))
        inset.set(xlim=centre[0] + 0.6 * spread * np.array([-1, 1]), ylim=centre[1] + 0.6 * spread * np.array([-1, 1]))
        inset.tick_params(labelsize=6.5, color=FAINT, labelcolor=MUTED)
        inset.locator_params(nbins=3)
        axes.indicate_inset_zoom(inset, edgecolor=MUTED)
        panels.append(inset)
    for panel in panels:
        panel.plot(np.cos(angle), np.sin(angle), color=MUTED, linewidth=1, zorder=1)
        for name, color in _SIDES.items():
            here = values[side == name]
            style = {"s": 20, "color": color, "alpha": 0.7, "linewidths": 0, "zorder": 2 + list(_SIDES).index(name)}
            panel.scatter(here.real, here.imag, **style)
    counts = [f"{int((side == name).sum())} {name}" for name in _SIDES]
    radius = f"{len(values)} eigenvalues, radius {size.max():.5g}"
    tidy(axes, f"{radius}\n{', '.join(counts)} the unit circle")


def _draw_errors(axes: Axes, errors: Mapping[str, Any], task: Task) -> None:
    part = next(iter(errors["koopman"]))
    shown, factor = error_unit(part, task)
    steps = np.arange(1, errors["steps"] + 1)
    for model, (label, color) in _MODELS.items():
        values = factor * np.asarray(errors[model][part], dtype=float)
        axes.plot(steps, np.where((values > 0) & (values < _DIVERGED), values, np.nan), ".-", color=color, label=label)
    axes.set_yscale("log")
    axes.margins(y=0.1)
    axes.set_xlabel(f"control steps ahead, {1e3 / task.control_hz:.0f} ms each\n(latent actions given)")
    axes.set_ylabel("root mean square distance" + (f" ({shown})" if shown else ""))
    axes.xaxis.set_major_locator(MaxNLocator(6, integer=True))
    judged = f"on {errors['held_out_trajectories']} demonstrations"
    put_legend(axes, below=0.27)
    tidy(axes, f"Error of the predicted {part.replace('_', ' ')}\n{judged}", grid=True)


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
    axes.set_ylim(0, 1.3 if len(names) > 4 else 1.12)  # room for the upright numbers
    axes.set_xlim(-0.6, len(names) - 0.4)  # an action without a value has its place too
    axes.set_xticks(places, [shorten(name) for name in names], fontsize=8, rotation=45 if len(names) > 4 else 0)
    axes.set_yticks((0, 0.25, 0.5, 0.75, 1))
    axes.set_ylabel("share of variance explained (R²)")
    if len(names) > 4:  # below the rotated names
        handles, labels = axes.get_legend_handles_labels()
        axes.figure.legend(handles, labels, loc="outside lower right", ncols=2, frameon=False, fontsize=8)
    else:
        put_legend(axes, below=0.22, columnspacing=1)
    tidy(axes, "True actions from latent actions\non the same held-out demonstrations")
