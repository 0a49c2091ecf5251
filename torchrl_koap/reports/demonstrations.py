# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws the demonstrations and their labelled steps: from above, or column by column over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchrl_koap.reports.pictures import picture
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.reports.scenes import bodies_of, body_handles, draw_bodies, draw_scene, keep_inside
from torchrl_koap.reports.style import BLUE, GREY, entry, panels, set_title, shorten, tidy, with_unit
from torchrl_koap.tasks import Task

_MOST_COLUMNS = 12  # panels of single state columns at most
_HANDLES = (
    Line2D([], [], color=BLUE, linewidth=1.7, label="with action label"),
    Line2D([], [], color=GREY, linewidth=0.9, label="states only"),
)


def _caption(run: RunFacts) -> str:
    objects = " Beside it the objects that were moved." if run.task is not None and run.task.bodies else ""
    return f"Blue: steps with an action that the training may read. Grey: states only.{objects}"


@picture(
    "demonstrations.png",
    source="demonstrations.safetensors",
    title="Demonstrations and labels",
    caption=_caption,
    order=80,
)
def draw_demonstrations(demonstrations: Mapping[str, Any], run: RunFacts) -> Figure:
    """Draws the demonstrations; transitions with an action label are emphasised, the others grey.

    Entries: ``episode``, ``labelled`` ``[N]``; without an environment ``state`` ``[N, d]``, drawn over time, else
    ``position`` ``[N, 2]`` (m), and optionally ``objects`` ``[N, bodies, 2]`` (m), which get a panel.
    """
    episode = entry(demonstrations, "episode", [None])
    labelled = entry(demonstrations, "labelled", [len(episode)]).astype(bool)
    borders = np.flatnonzero(np.diff(episode) != 0) + 1
    along = np.flatnonzero(labelled[:-1] & (episode[1:] == episode[:-1]))  # steps with a next state in their episode
    share = f"{labelled.mean():.1%}" if len(labelled) else "none"
    number, touched = len(borders) + 1, len(np.unique(episode[labelled]))
    head = f"{number} demonstrations; labels on {int(labelled.sum()):,} of {len(labelled):,} transitions ({share})"
    if run.task is not None and run.offline:  # planar positions are known only for tasks with an environment
        state = entry(demonstrations, "state", [len(episode), run.task.state_dim])
        return _draw_over_time(state, borders, along, run.task, f"{head} in {touched} of them")
    position = entry(demonstrations, "position", [len(episode), 2])
    moved = "objects" in demonstrations
    figure = Figure(figsize=(10.9, 6.2) if moved else (5.9, 6.4), layout="constrained")
    axes, *beside = figure.subplots(1, 1 + moved, squeeze=False, sharex=True, sharey=True)[0]
    for panel in beside:
        objects = np.split(entry(demonstrations, "objects", [len(episode), None, 2]), borders)
        draw_bodies(draw_scene(panel, run.task), objects, run.task, [True] * len(objects))
        panel.label_outer()
        handles = body_handles([body for body in bodies_of(run.task, objects[0].shape[1]) if not body.still], [True])
        panel.legend(handles=handles, frameon=False, fontsize=8.5, loc="upper left", bbox_to_anchor=(1, 1))
        set_title(panel, "objects: paths and ends\n")
    draw_scene(axes, run.task)
    _draw_lines(axes, position, borders, along, (0.7, 1.7))
    keep_inside(axes, [position])
    set_title(axes, f"{head}\nin {touched} of {number} demonstrations")
    axes.legend(handles=_HANDLES, fontsize=8.5, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, frameon=False)
    return figure


def _draw_over_time(state: np.ndarray, borders: np.ndarray, along: np.ndarray, task: Task, head: str) -> Figure:
    first = np.concatenate([[0], borders]).astype(int)
    time = (np.arange(len(state)) - np.repeat(first, np.diff(np.append(first, len(state))))) / task.control_hz
    columns = list(zip(task.state_names, task.state_units, strict=True))
    drawn = columns[:_MOST_COLUMNS]
    figure, beside = panels(len(drawn), 4, (2.9, 2.1), (2.7 if len(drawn) == 1 else 0, 1.1))
    for index, axes in enumerate(beside):
        _draw_lines(axes, np.column_stack([time, state[:, index]]), borders, along, (0.6, 1.3))
        axes.autoscale_view()
        name, unit = columns[index]
        set_title(axes, with_unit(shorten(name, 24), unit))
        if index + 4 >= len(drawn):
            axes.set_xlabel("time (s)")
        tidy(axes)
    rest = f"; {len(columns) - len(drawn)} columns are not drawn" if len(drawn) < len(columns) else ""
    figure.suptitle(head + rest, fontsize=9.5, x=0.01, ha="left")
    figure.legend(handles=_HANDLES, fontsize=8.5, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _draw_lines(
    axes: Axes, points: np.ndarray, borders: np.ndarray, along: np.ndarray, widths: tuple[float, float]
) -> None:
    """Draws grey paths, and blue segments where steps are labelled."""
    grey, blue = widths
    axes.add_collection(LineCollection(np.split(points, borders), colors=GREY, linewidths=grey, alpha=0.8, zorder=2))
    labelled = np.stack([points[along], points[along + 1]], 1)
    axes.add_collection(LineCollection(labelled, colors=BLUE, linewidths=blue, capstyle="round", zorder=3))
