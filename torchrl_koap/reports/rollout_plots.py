# This source code is licensed under the MIT license found in the LICENSE file.
"""Pictures of paths over the scene from above: rollouts, and plans against execution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from torchrl_koap.reports.mode_colors import mode_colors
from torchrl_koap.reports.mode_plots import draw_mode_table
from torchrl_koap.reports.objects import legend_handles, object_looks, object_paths
from torchrl_koap.reports.paths import (
    color_of,
    draw_bodies,
    draw_failure,
    entry_of,
    has_objects,
    keep_inside,
    read_rollouts,
    scene_caption,
)
from torchrl_koap.reports.pictures import NothingToDraw, picture
from torchrl_koap.reports.scenes import draw_scene
from torchrl_koap.reports.style import (
    FAILURE_MARKS,
    INK,
    OUTCOMES,
    SUCCESS,
    as_array,
    save_figure,
    set_title,
    thousandths,
)
from torchrl_koap.tasks.modes import mode_choices, mode_name


@picture(
    "rollouts.png",
    source="rollouts.safetensors",
    title="Executed rollouts",
    caption="Path of the tool centre from above, to scale; a colour per mode, the table counts successes per mode."
    " Failures are black and end in a cross (collision) or a square (out of time).",
    caption_of=scene_caption,
    place=10,
)
def plot_rollouts(
    rollouts: Mapping[str, Any], path: str | Path, *, task: str | None = "avoiding", num_modes: int | None = None
) -> Path:
    """Executed paths over the scene, coloured by mode; failures are black and marked where they end.

    A second panel shows the bodies of tasks that have them: where they start, their paths, where they end.

    Args:
        rollouts (mapping): ``position`` [E, T, 2] (m, NaN after the end), ``length`` [E], ``mode`` [E] (-1 none),
            ``outcome`` [E] (0 out of time, 1 success, 2 collision); optionally ``object_position`` [E, T, objects, 2]
            (m) and ``context`` [E, objects, 3] (x, y in m, yaw in rad).
        path (str or Path): png to write.
        task (str, optional): task whose scene and modes are drawn.
        num_modes (int, optional): number of modes, needed where the task names no choices.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.reports.rollout_plots import plot_rollouts
        >>> one = {"position": torch.rand(1, 9, 2), "length": [9], "mode": [3], "outcome": [1]}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_rollouts(one, f"{folder}/rollouts.png").name
        'rollouts.png'
    """
    paths, mode, outcome = read_rollouts(rollouts)
    choices, colors = mode_choices(task, num_modes), mode_colors(task, num_modes)
    bodies = object_paths(rollouts)
    good, crowded = outcome == SUCCESS, sum(map(len, paths)) > 8000
    if bodies is None:
        figure = Figure(figsize=(8.4, 5.9), layout="constrained")
        axes, side = figure.subplots(1, 2, width_ratios=(2.15, 1))
        draw_scene(axes, task)
    else:
        figure = Figure(layout="constrained")
        axes, beside, side = figure.subplots(1, 3)
        share = abs(np.ptp(draw_scene(axes, task).get_xlim()) / np.ptp(axes.get_ylim()))
        figure.set_size_inches(10 * share + 4.4, 5.6)
        axes.get_gridspec().set_width_ratios((5 * share, 5 * share, 3.2))
        draw_scene(beside, task).label_outer()
        draw_bodies(beside, bodies, rollouts.get("context"), task, good)
        set_title(beside, "objects: starts (pale), paths, ends")
    axes.add_collection(
        LineCollection(
            [paths[index] for index in np.flatnonzero(good)],
            colors=[color_of(mode[index], colors) for index in np.flatnonzero(good)],
            linewidths=0.6 if crowded else 1.1,
            alpha=0.55 if crowded else 0.85,
            zorder=2,
        )
    )
    for index in np.flatnonzero(~good):
        draw_failure(axes, paths[index], outcome[index])
    keep_inside(axes, paths)
    if bodies is not None:
        keep_inside(beside, [path.reshape(-1, 2) for path in bodies])
    counts = [f"{int(good.sum())} of {len(good)} rollouts succeed"]
    counts += [f"{OUTCOMES[kind]}: {int((outcome == kind).sum())}" for kind in FAILURE_MARKS if (outcome == kind).any()]
    set_title(axes, ", ".join(counts))
    draw_mode_table(side, mode[good], choices, colors)
    marks = [
        Line2D([], [], color=INK, linewidth=1.2, marker=mark, markersize=7, label=OUTCOMES[kind])
        for kind, mark in FAILURE_MARKS.items()
        if (outcome == kind).any()
    ]
    if bodies:
        marks += legend_handles(object_looks(task, bodies[0].shape[1]), good)
    if marks:
        below = {"bbox_to_anchor": (side.get_xlim()[0], side.dataLim.y0 - 0.2), "bbox_transform": side.transData}
        side.legend(handles=marks, frameon=False, fontsize=8.5, loc="upper left", **below)
    return save_figure(figure, path)


@picture(
    "plans.png",
    source="rollouts.safetensors",
    title="Plans against execution",
    caption="Wide pale band: the executed path. Thin lines: every plan of that episode; dots: where each was made. A"
    " plan that leaves the band at once was not followed (the controller errs); plans that fan out at their ends were"
    " followed, then replaced (the planner revises). Distances are to the nearest point of the path, whatever the"
    " time; what was planned beyond its end does not count. Failures come first.",
    caption_of=has_objects(" Outlines and thin coloured lines are the objects of that episode: starts and paths."),
    place=50,
    empty="the rollouts hold no plans of positions",
)
def plot_plans(
    rollouts: Mapping[str, Any],
    path: str | Path,
    *,
    task: str | None = "avoiding",
    num_modes: int | None = None,
    episodes: Sequence[int] | None = None,
    count: int = 6,
) -> Path:
    """Every plan of a few episodes over the path that was executed.

    Args:
        rollouts (mapping): the entries of :func:`plot_rollouts`, ``plan`` [E, P, H, 2] (m, NaN padded) and
            ``plan_step`` [E, P], the control step at which each plan was made (-1 padding).
        path (str or Path): png to write.
        task (str, optional): task whose scene and modes are drawn.
        num_modes (int, optional): number of modes, needed where the task names no choices.
        episodes (sequence of int, optional): episodes to draw. Default: up to two failures, then successes of as many
            different modes as possible.
        count (int): number of episodes drawn by default.

    Raises:
        ValueError: if an entry is missing or has a wrong shape, or an episode does not exist.
        NothingToDraw: if no plan was kept.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.reports.rollout_plots import plot_plans
        >>> one = {"position": torch.rand(1, 9, 2), "length": [9], "mode": [3], "outcome": [1]}
        >>> one |= {"plan": torch.rand(1, 2, 14, 2), "plan_step": torch.tensor([[0, 4]])}
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_plans(one, f"{folder}/plans.png").name
        'plans.png'
    """
    paths, mode, outcome = read_rollouts(rollouts)
    plan = as_array("plan", entry_of(rollouts, "plan"), [len(paths), None, None, 2])
    if not plan.shape[1]:
        raise NothingToDraw("the rollouts hold no plans of positions")
    plan_step = as_array("plan_step", entry_of(rollouts, "plan_step"), plan.shape[:2])
    colors, bodies = mode_colors(task, num_modes), object_paths(rollouts)
    if episodes is None:
        episodes = choose_episodes(mode, outcome, count)
    wrong = [index for index in episodes if not 0 <= index < len(paths)]
    if wrong:
        raise ValueError(f"episodes must be 0 to {len(paths) - 1}, got {wrong[0]}")
    across = min(len(episodes), 3)
    down = math.ceil(len(episodes) / max(across, 1))
    figure = Figure(figsize=(3.8 * across + 0.3, 4.25 * down + 0.3), layout="constrained")
    for place, index in enumerate(episodes):
        axes = draw_scene(figure.add_subplot(down, across, place + 1), task)
        color = INK if outcome[index] != SUCCESS else color_of(mode[index], colors)
        if bodies is not None:
            context = rollouts["context"][index : index + 1] if "context" in rollouts else None
            draw_bodies(axes, bodies[index : index + 1], context, task, outcome[index : index + 1] == SUCCESS)
        axes.plot(*paths[index].T, color=color, linewidth=5, alpha=0.4, zorder=2, solid_capstyle="round")
        made = [(plan[index, row], int(plan_step[index, row])) for row in np.flatnonzero(plan_step[index] >= 0)]
        lines = [points[np.isfinite(points).all(1)] for points, _ in made]
        axes.add_collection(LineCollection(lines, colors=[INK], linewidths=0.6, zorder=3))
        starts = np.array([paths[index][step] for _, step in made if step < len(paths[index])]).reshape(-1, 2)
        axes.scatter(*starts.T, s=5, color=INK, linewidths=0, zorder=4)
        if outcome[index] in FAILURE_MARKS and len(paths[index]):
            mark = FAILURE_MARKS[outcome[index]]
            axes.scatter(*paths[index][-1], s=70, marker=mark, color=INK, edgecolors="white", linewidths=0.8, zorder=6)
        keep_inside(axes, [paths[index], *lines])
        stray = plan_deviation(paths[index], lines)
        what = mode_name(int(mode[index]), task, num_modes) if outcome[index] == SUCCESS else OUTCOMES[outcome[index]]
        note = "no plan within the path"
        if len(stray):
            unit, factor = thousandths("m")
            middle, most = factor * np.quantile(stray, [0.5, 0.95])
            note = f"off the path: median {middle:.1f}, 95 % within {most:.1f} {unit}"
        set_title(axes, f"episode {index}: {what}\n{note}")
        axes.label_outer()
    return save_figure(figure, path)


def choose_episodes(mode: Any, outcome: Any, count: int) -> list[int]:
    """Numbers of the episodes worth showing.

    Up to two failures, then successes, a new mode each as long as there are any, then what is left.

    Args:
        mode (array): mode of every episode, int [E]; -1 where it has none.
        outcome (array): outcome of every episode, int [E]; 1 is success.
        count (int): how many to choose at most.

    Returns:
        list of int: rows of the arrays.

    Examples:
        >>> from torchrl_koap.reports.rollout_plots import choose_episodes
        >>> choose_episodes([0, 0, 5, 9, -1], [1, 1, 1, 1, 2], 4)
        [4, 0, 2, 3]
    """
    mode, outcome = as_array("mode", mode, [None]), as_array("outcome", outcome, [None])
    bad = np.flatnonzero(outcome != SUCCESS).tolist()
    chosen, spare = bad[: min(2, count)], bad[2:]
    good = np.flatnonzero(outcome == SUCCESS)
    firsts = [int(good[mode[good] == value][0]) for value in np.unique(mode[good])]
    room = count - len(chosen)
    if len(firsts) > room:
        firsts = [firsts[int(index)] for index in np.linspace(0, len(firsts) - 1, max(room, 0)).round()]
    rest = [int(index) for index in good if index not in firsts]
    return chosen + (firsts + rest + spare)[: max(room, 0)]


def plan_deviation(path: np.ndarray, plans: Sequence[np.ndarray]) -> np.ndarray:
    """Distance of every planned point from the nearest point of the executed path, whatever the time (m).

    Points planned beyond the path's end are left out: nothing was executed there.

    Args:
        path (np.ndarray): executed positions [L, 2].
        plans (sequence): planned positions [H, 2] each.

    Returns:
        np.ndarray: distances, one per planned point that was reached.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.reports.rollout_plots import plan_deviation
        >>> path = np.stack([np.arange(5.0), np.zeros(5)], axis=1)
        >>> plan_deviation(path, [np.array([[1.5, 0.25], [6.0, 0.0]])]).tolist()
        [0.25]
    """
    points = np.concatenate([np.zeros((0, 2)), *plans])
    if len(path) < 2 or not len(points):
        return np.zeros(0)
    start, along = path[:-1], np.diff(path, axis=0)
    square = np.maximum(np.square(along).sum(1), 1e-18)
    offset = points[:, None] - start  # [points, L-1, 2]
    share = (offset * along).sum(-1) / square
    distance = np.linalg.norm(offset - np.clip(share, 0, 1)[..., None] * along, axis=-1)
    nearest = distance.argmin(1)
    beyond = (nearest == len(along) - 1) & (share[:, -1] > 1)
    return distance.min(1)[~beyond]
