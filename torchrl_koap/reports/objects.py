# This source code is licensed under the MIT license found in the LICENSE file.
"""The bodies that a task's contexts place, from above: where they start, their paths, where they end.

Their sizes and colours are those of ``Task.bodies``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from torchrl_koap.reports.scenes import color_of
from torchrl_koap.reports.style import INK, MUTED, as_array
from torchrl_koap.tasks import Body
from torchrl_koap.tasks.registry import find_task

MANY = 20
_UNKNOWN = Body("objects", position="")


def object_looks(task: str | None, number: int) -> tuple[Body, ...]:
    """A look for each of ``number`` bodies; grey ones where the task is not known or has another number.

    Args:
        task (str, optional): name of the task.
        number (int): number of bodies.

    Returns:
        tuple of Body: those of the task, their colours as matplotlib takes them.
    """
    known = find_task(task)
    looks = known.bodies if known is not None and len(known.bodies) == number else (_UNKNOWN,) * number
    return tuple(replace(look, color=color_of(look.color)) for look in looks)


def outlines(poses: np.ndarray, half: tuple[float, float]) -> np.ndarray:
    """Closed outlines of rectangles; the last side but one drawn, from point 2 to point 3, is the far one.

    Args:
        poses (np.ndarray): ``[..., 3]``: x, y (m), yaw (rad).
        half (tuple of float): half width and half depth (m).

    Returns:
        np.ndarray: ``[..., 5, 2]`` (m).

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.reports.objects import outlines
        >>> outlines(np.array([1.0, 2.0, np.pi / 2]), (0.5, 0.25))[2:4].round(6).tolist()
        [[0.75, 2.5], [0.75, 1.5]]
    """
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
    cosine, sine = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    turn = np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], -2)
    return corners @ turn + poses[..., None, :2]


def object_paths(rollouts: Mapping[str, Any]) -> list[np.ndarray] | None:
    """Paths of the bodies of each episode, without the padding, the state after the last step included.

    Args:
        rollouts (mapping): ``object_position`` [E, T, objects, 2] (m) and ``length`` [E].

    Returns:
        list: an array [frames, objects, 2] per episode; None if there is no such entry.

    Raises:
        ValueError: if an entry has a wrong shape.

    Examples:
        >>> import torch
        >>> from torchrl_koap.reports.objects import object_paths
        >>> [len(path) for path in object_paths({"object_position": torch.zeros(2, 9, 1, 2), "length": [4, 9]})]
        [5, 9]
    """
    if "object_position" not in rollouts:
        return None
    position = as_array("object_position", rollouts["object_position"], [None, None, None, 2])
    length = as_array("length", rollouts["length"], [len(position)])
    paths = [row[: max(int(number), 0) + 1] for row, number in zip(position, length, strict=True)]
    return [path[np.isfinite(path).all((1, 2))] for path in paths]


def draw_starts(axes: Axes, contexts: Any, looks: Sequence[Body]) -> None:
    """Outlines of the bodies as the contexts place them, paler the more there are.

    The far side of a body whose orientation matters is thick; of more than 20 only the centres are drawn, each with a
    line to its far side.

    Args:
        axes (Axes): where to draw.
        contexts (array): ``[E, objects, 3]``: x, y (m), yaw (rad).
        looks (sequence of Body): one per body.

    Raises:
        ValueError: if the contexts have another shape.
    """
    contexts = as_array("context", contexts, [None, len(looks), 3]).astype(float)
    many = len(contexts) > MANY
    opacity = float(np.clip(4 / max(len(contexts), 1), 0.13, 0.8))
    for index, look in enumerate(looks):
        outline = outlines(contexts[:, index], look.half)
        style = {"colors": look.color, "zorder": 1.5}
        if look.front and many:
            centre, front = outline[:, :4].mean(1), outline[:, 2:4].mean(1)
            axes.add_collection(LineCollection(np.stack([centre, front], 1), alpha=0.5, linewidths=0.9, **style))
            axes.scatter(*centre.T, s=7, color=look.color, alpha=0.5, linewidths=0, zorder=1.5)
            continue
        dashes = "--" if look.still else "-"
        axes.add_collection(LineCollection(outline, alpha=opacity, linewidths=0.8, linestyles=dashes, **style))
        if look.front:
            axes.add_collection(LineCollection(outline[:, 2:4], alpha=opacity, linewidths=2.2, **style))


def draw_object_paths(axes: Axes, paths: Sequence[np.ndarray], looks: Sequence[Body], good: Sequence[bool]) -> None:
    """Thin paths of the bodies in their colours; a dot where they end, a cross in episodes that failed.

    Args:
        axes (Axes): where to draw.
        paths (sequence): positions [frames, objects, 2] (m) of each episode.
        looks (sequence of Body): one per body.
        good (sequence of bool): whether each episode succeeded.
    """
    opacity = float(np.clip(8 / max(len(paths), 1), 0.3, 0.9))
    shown = [(path, fine) for path, fine in zip(paths, good, strict=True) if len(path)]
    for index, look in enumerate(looks):
        if look.still:
            continue
        lines = [path[:, index] for path, _ in shown]
        style: dict[str, Any] = {"linewidths": 0.7, "alpha": opacity, "zorder": 2}
        axes.add_collection(LineCollection(lines, colors=look.color, **style))
        for fine, mark in ((True, "o"), (False, "X")):
            ends = np.array([path[-1, index] for path, kind in shown if bool(kind) is fine]).reshape(-1, 2)
            style = {"s": 20 if fine else 32, "marker": mark, "linewidths": 0.5, "zorder": 3 if fine else 4}
            axes.scatter(*ends.T, color=look.color, edgecolors="white" if fine else INK, **style)


def legend_handles(looks: Sequence[Body], good: Sequence[bool] = ()) -> list[Line2D]:
    """Entries of a legend: every kind of body once, and the marks of :func:`draw_object_paths` that occur.

    Args:
        looks (sequence of Body): bodies that are drawn.
        good (sequence of bool): whether each drawn episode succeeded.

    Returns:
        list of Line2D: handles with labels, for ``axes.legend(handles=...)``.
    """
    handles: dict[Any, Line2D] = {}
    for look in looks:
        style = {"linestyle": "--" if look.still else "-", "linewidth": 1.6}
        handles.setdefault(look.label, Line2D([], [], color=look.color, label=look.label, **style))
    for fine, mark, label in ((True, "o", "end"), (False, "X", "end of a failure")):
        if any(bool(kind) is fine for kind in good):
            handles[label] = Line2D([], [], color=MUTED, marker=mark, linestyle="none", markersize=5, label=label)
    return list(handles.values())
