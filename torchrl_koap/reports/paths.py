# This source code is licensed under the MIT license found in the LICENSE file.
"""Paths over a scene from above: what the pictures of rollouts, plans and films read and draw alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from torchrl_koap.reports.objects import draw_object_paths, draw_starts, object_looks
from torchrl_koap.reports.style import FAILURE_MARKS, INK, NO_MODE, as_array
from torchrl_koap.tasks.registry import find_task

_MOST_ROOM = 0.5  # of the scene's own size is added on a side where paths leave it, at most


def scene_caption(task: str | None) -> str:
    """What the caption of the rollouts adds for a task."""
    known = find_task(task)
    return known.scene.caption if known else ""


def has_objects(sentence: str) -> Callable[[str | None], str]:
    """Adds a sentence to the caption of tasks with objects."""

    def caption_of(task: str | None) -> str:
        known = find_task(task)
        return sentence if known and known.bodies else ""

    return caption_of


def executed_paths(rollouts: Mapping[str, Any]) -> list[np.ndarray]:
    """Positions of each episode, without the padding.

    Args:
        rollouts (mapping): ``position`` [E, T, 2] (m) and ``length`` [E].

    Returns:
        list: an array [length, 2] per episode.

    Raises:
        ValueError: if an entry is missing or has a wrong shape.

    Examples:
        >>> import torch
        >>> from torchrl_koap.reports.paths import executed_paths
        >>> [len(path) for path in executed_paths({"position": torch.zeros(2, 9, 2), "length": torch.tensor([4, 9])})]
        [4, 9]
    """
    position = as_array("position", entry_of(rollouts, "position"), [None, None, 2])
    length = as_array("length", entry_of(rollouts, "length"), [len(position)])
    paths = [row[: max(int(number), 0)] for row, number in zip(position, length, strict=True)]
    return [path[np.isfinite(path).all(1)] for path in paths]


def draw_bodies(axes: Axes, paths: Sequence[np.ndarray], contexts: Any, task: str | None, good: Sequence[bool]) -> None:
    """Start outlines (if there are contexts), paths and ends of a task's bodies.

    Args:
        axes (Axes): where to draw.
        paths (sequence): positions [frames, objects, 2] (m) of each episode.
        contexts (array, optional): ``[E, objects, 3]``.
        task (str, optional): the task.
        good (sequence of bool): whether each episode succeeded.
    """
    looks = object_looks(task, paths[0].shape[1] if len(paths) else 0)
    if contexts is not None:
        draw_starts(axes, contexts, looks)
    draw_object_paths(axes, paths, looks, good)
    keep_inside(axes, [path.reshape(-1, 2) for path in paths])


def keep_inside(axes: Axes, paths: Sequence[np.ndarray]) -> None:
    """Widens a panel until paths lie inside it, on every side by at most half of what it showed before.

    Args:
        axes (Axes): the panel; one that shows no scene yet is fitted to the paths.
        paths (sequence): positions [n, 2] (m) each.
    """
    points = np.concatenate([np.zeros((0, 2)), *paths])
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return
    fresh = axes.get_autoscale_on()  # nobody has set limits
    low, high = points.min(0), points.max(0)
    margin = 0.03 * np.maximum(high - low, 1e-3)
    for now, change, start, end in (
        (axes.get_xlim(), axes.set_xlim, low[0] - margin[0], high[0] + margin[0]),
        (axes.get_ylim(), axes.set_ylim, low[1] - margin[1], high[1] + margin[1]),
    ):
        if fresh:
            change(start, end)
        else:
            room = _MOST_ROOM * (now[1] - now[0])
            change(max(min(now[0], start), now[0] - room), min(max(now[1], end), now[1] + room), auto=False)


def draw_failure(axes: Axes, path: np.ndarray, outcome: int) -> None:
    """The path of an episode that failed, with a mark where it ended.

    Args:
        axes (Axes): where to draw.
        path (np.ndarray): positions [n, 2] (m).
        outcome (int): number of the outcome, see ``FAILURE_MARKS``.
    """
    axes.plot(*path.T, color=INK, linewidth=1.2, zorder=4)
    if len(path):
        mark = FAILURE_MARKS.get(int(outcome), "D")
        axes.scatter(*path[-1], s=75, marker=mark, color=INK, edgecolors="white", linewidths=0.9, zorder=5)


def read_rollouts(rollouts: Mapping[str, Any]) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Paths of all episodes, their modes and outcomes."""
    paths = executed_paths(rollouts)
    mode = as_array("mode", entry_of(rollouts, "mode"), [len(paths)]).astype(int)
    outcome = as_array("outcome", entry_of(rollouts, "outcome"), [len(paths)]).astype(int)
    return paths, mode, outcome


def entry_of(data: Mapping[str, Any], key: str) -> Any:
    """An entry that has to be there.

    Args:
        data (mapping): the entries.
        key (str): its name.

    Raises:
        ValueError: if it is missing; the message lists those that are there.
    """
    if key not in data:
        raise ValueError(f"missing entry {key!r}; got {', '.join(sorted(map(str, data))) or 'nothing'}")
    return data[key]


def color_of(mode: int, colors: np.ndarray) -> Any:
    """The colour of a mode, that of no mode where it has none.

    Args:
        mode (int): number of the mode, -1 if it is not decided.
        colors (np.ndarray): a colour per mode.
    """
    return colors[mode] if 0 <= mode < len(colors) else NO_MODE
