# This source code is licensed under the MIT license found in the LICENSE file.
"""Draws a task from above: still shapes, bodies, paths of tool and bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle

from torchrl_koap.lookup import lookup
from torchrl_koap.reports.style import BLUE, FAILURE_MARKS, FAINT, GREEN, INK, MUTED, RED, entry, tidy
from torchrl_koap.tasks import Body, Shape, Task

# style of each role; a shape's own colour overrides the role's
ROLES = {
    "clearance": {"facecolor": "#e9ebee", "edgecolor": "none", "zorder": 0.5},
    "obstacle": {"facecolor": "#7b828d", "edgecolor": "#565c66", "linewidth": 0.8, "zorder": 0.6},
    "finish": {"color": GREEN, "linewidth": 1.4, "zorder": 0.7},
    "region": {"facecolor": "#f4f5f7", "edgecolor": FAINT, "linewidth": 0.8, "linestyle": "--", "zorder": 0.5},
    "platform": {"facecolor": "#eef0f3", "edgecolor": FAINT, "zorder": 0.4},
    "wall": {"color": MUTED, "alpha": 0.45, "linewidth": 0, "zorder": 0.6},
    "zone": {"facecolor": "#fff3e0", "edgecolor": "#d9730d", "linewidth": 0.8, "zorder": 0.5},
    "target": {"facecolor": "#ffe0b8", "edgecolor": "none", "zorder": 0.6},
}
MANY = 20  # contexts; with more, bodies with an orientation are drawn as centre and line
_NAMED = {"red": RED, "green": GREEN, "blue": BLUE, "grey": MUTED}
_LABEL_COLORS = {"finish": GREEN, "zone": "#9a5b13"}
_MOST_ROOM = 0.5  # share of the scene's size that is added at most on a side where paths leave it
_UNKNOWN = Body("objects", position="")


def color_of(name: str) -> str:
    """Returns the colour that pictures use for a name such as ``"red"``; keeps others, such as ``"#9a5b13"``."""
    return _NAMED.get(name, name)


def draw_scene(axes: Axes, task: Task | None) -> Axes:
    """Draws the still shapes of a task, if there is one, to scale, with axes in metres, and returns the axes."""
    if task is not None:
        for shape in task.scene.shapes:
            _draw_shape(axes, shape)
        if task.scene.x is not None:
            axes.set_xlim(*task.scene.x)
        if task.scene.y is not None:
            axes.set_ylim(*task.scene.y)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    return tidy(axes)


def _draw_shape(axes: Axes, shape: Shape) -> None:
    style = dict(lookup(ROLES, shape.role, "role of a shape"))
    if shape.color is not None:
        style["color" if "color" in style else "facecolor"] = color_of(shape.color)
    (x, y), (width, depth) = shape.center, shape.half
    if shape.kind == "circle":
        axes.add_patch(Circle((x, y), width, **style))
    elif shape.kind == "rectangle":
        axes.add_patch(Rectangle((x - width, y - depth), 2 * width, 2 * depth, **style))
    else:
        axes.plot([x - width, x + width], [y - depth, y + depth], **style)
    if shape.label:
        word = {"color": _LABEL_COLORS.get(shape.role, MUTED), "fontsize": 7.5, "va": "bottom"}
        if shape.kind == "line":
            place = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
            axes.annotate(shape.label, (1, y), (-3, 2), ha="right", **place, **word)
        else:
            axes.text(x, y + depth + 0.004, shape.label, ha="center", **word)


def keep_inside(axes: Axes, paths: Sequence[np.ndarray]) -> None:
    """Widens a panel until paths ``[n, 2]`` (m) lie inside it, on every side by at most half of its previous size.

    A panel without a scene is fitted to the paths.
    """
    points = np.concatenate([np.zeros((0, 2)), *paths])
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return
    fresh = axes.get_autoscale_on()  # true if no limits were set
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


def read_episodes(rollouts: Mapping[str, Any]) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Returns the positions ``[length, 2]`` (m) of each episode without padding, and modes and outcomes ``[E]``."""
    paths = _paths(rollouts, "position", [None, None, 2])
    mode, outcome = (entry(rollouts, key, [len(paths)]).astype(int) for key in ("mode", "outcome"))
    return paths, mode, outcome


def body_paths(rollouts: Mapping[str, Any]) -> list[np.ndarray]:
    """Returns the body paths ``[frames, bodies, 2]`` (m) of each episode, with the last state; none without bodies."""
    if "object_position" not in rollouts:
        return []
    return _paths(rollouts, "object_position", [None, None, None, 2], last=1)


def _paths(rollouts: Mapping[str, Any], key: str, shape: Sequence[int | None], last: int = 0) -> list[np.ndarray]:
    position = entry(rollouts, key, shape)
    length = entry(rollouts, "length", [len(position)])
    paths = [row[: int(number) + last] for row, number in zip(position, length, strict=True)]
    return [path[np.isfinite(path).all(tuple(range(1, path.ndim)))] for path in paths]


def bodies_of(task: Task | None, number: int) -> tuple[Body, ...]:
    """Returns ``number`` bodies to draw; grey ones if the task is unknown or has another number."""
    bodies = task.bodies if task is not None and len(task.bodies) == number else (_UNKNOWN,) * number
    return tuple(replace(body, color=color_of(body.color)) for body in bodies)


def draw_bodies(
    axes: Axes, paths: Sequence[np.ndarray], task: Task | None, good: Sequence[bool], contexts: Any = None
) -> None:
    """Draws the bodies of a task: start outlines (if there are contexts), paths in their colours, ends.

    Paths are positions ``[frames, bodies, 2]`` (m) of each episode, contexts ``[E, bodies, 3]`` starts: x, y (m),
    yaw (rad). Ends are dots in ``good`` episodes, else crosses.
    """
    bodies = bodies_of(task, paths[0].shape[1] if len(paths) else 0)
    if contexts is not None:
        draw_starts(axes, contexts, bodies)
    opacity = float(np.clip(8 / max(len(paths), 1), 0.3, 0.9))
    shown = [(path, fine) for path, fine in zip(paths, good, strict=True) if len(path)]
    for index, body in enumerate(bodies):
        if body.still:
            continue
        lines = [path[:, index] for path, _ in shown]
        axes.add_collection(LineCollection(lines, colors=body.color, linewidths=0.7, alpha=opacity, zorder=2))
        for fine, mark in ((True, "o"), (False, "X")):
            ends = np.array([path[-1, index] for path, kind in shown if bool(kind) is fine]).reshape(-1, 2)
            style = {"s": 20 if fine else 32, "marker": mark, "linewidths": 0.5, "zorder": 3 if fine else 4}
            axes.scatter(*ends.T, color=body.color, edgecolors="white" if fine else INK, **style)
    keep_inside(axes, [path.reshape(-1, 2) for path in paths])


def draw_starts(axes: Axes, contexts: Any, bodies: Sequence[Body]) -> None:
    """Draws outlines of bodies at contexts ``[E, bodies, 3]`` (x, y in m, yaw in rad), paler if there are many.

    The far side of a body whose orientation matters is thick; for more than 20 contexts such a body is drawn as its
    centre with a line to the far side.
    """
    contexts = entry({"context": contexts}, "context", [None, len(bodies), 3]).astype(float)
    many = len(contexts) > MANY
    opacity = float(np.clip(4 / max(len(contexts), 1), 0.13, 0.8))
    for index, body in enumerate(bodies):
        outline = outlines(contexts[:, index], body.half)
        style = {"colors": body.color, "zorder": 1.5}
        if body.front and many:
            centre, front = outline[:, :4].mean(1), outline[:, 2:4].mean(1)
            axes.add_collection(LineCollection(np.stack([centre, front], 1), alpha=0.5, linewidths=0.9, **style))
            axes.scatter(*centre.T, s=7, color=body.color, alpha=0.5, linewidths=0, zorder=1.5)
            continue
        dashes = "--" if body.still else "-"
        axes.add_collection(LineCollection(outline, alpha=opacity, linewidths=0.8, linestyles=dashes, **style))
        if body.front:
            axes.add_collection(LineCollection(outline[:, 2:4], alpha=opacity, linewidths=2.2, **style))


def outlines(poses: np.ndarray, half: tuple[float, float]) -> np.ndarray:
    """Returns closed outlines ``[..., 5, 2]`` (m) of rectangles at poses ``[..., 3]`` (x, y in m, yaw in rad).

    ``half`` is their half width and half depth (m); the side from point 2 to point 3 is the far one.
    """
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half
    cosine, sine = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    turn = np.stack([np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)], -2)
    return corners @ turn + poses[..., None, :2]


def body_handles(bodies: Sequence[Body], good: Sequence[bool] = ()) -> list[Line2D]:
    """Returns legend handles: every kind of body once, and the marks of :func:`draw_bodies` that occur.

    ``good`` says whether each drawn episode succeeded.
    """
    handles: dict[str, Line2D] = {}
    for body in bodies:
        style = {"linestyle": "--" if body.still else "-", "linewidth": 1.6}
        handles.setdefault(body.label, Line2D([], [], color=body.color, label=body.label, **style))
    for fine, mark, label in ((True, "o", "end"), (False, "X", "end of a failure")):
        if any(bool(kind) is fine for kind in good):
            handles[label] = Line2D([], [], color=MUTED, marker=mark, linestyle="none", markersize=5, label=label)
    return list(handles.values())


def draw_failure_end(axes: Axes, path: np.ndarray, outcome: int) -> None:
    """Marks the end of a failed episode's path ``[n, 2]`` (m), by the number of its outcome."""
    if len(path):
        mark = FAILURE_MARKS.get(int(outcome), "D")
        axes.scatter(*path[-1], s=75, marker=mark, color=INK, edgecolors="white", linewidths=0.9, zorder=6)
