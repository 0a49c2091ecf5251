# This source code is licensed under the MIT license found in the LICENSE file.
"""Contexts: poses of the objects of a task at the start of an episode.

A context is ``[objects, 3]``: x, y (m) and yaw (rad) of every object of ``Task.objects``.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from torchrl_koap.data.d3il.unpickling import load_pickle
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.tasks.scene import Scene

TABLE = Path(__file__).with_name("evaluation_contexts.json")
NUM_EVALUATION_CONTEXTS = 60
_SLACK = 1e-6  # m; D3IL stores contexts in float32


def _scene(task: Task) -> Scene:
    if not task.scene.varies:
        raise ValueError(f"task {task.name!r} has no contexts: every episode starts the same")
    return task.scene


def draw_contexts(task: Task | str, num: int, generator: np.random.Generator | int | None = None) -> np.ndarray:
    """Draws random contexts from the ranges of a task, float64 ``[num, objects, 3]``; ``generator`` may be a seed."""
    task = get_task(task)
    scene = _scene(task)
    drawing = np.random.default_rng(generator)
    contexts = np.empty((num, len(task.objects), 3))
    for context in contexts:
        if scene.shared_starts:
            order = drawing.permutation(len(scene.shared_starts))
            regions = [scene.shared_starts[index] for index in order]
        else:  # a body with a single region draws nothing here
            own = [body.starts for body in scene.bodies]
            regions = [each[drawing.integers(len(each)) if len(each) > 1 else 0] for each in own]
        for row, (x, y) in zip(context, regions, strict=False):
            row[:] = drawing.uniform(*x), drawing.uniform(*y), math.radians(drawing.uniform(*scene.start_yaw))
    return contexts


def evaluation_contexts(task: Task | str) -> np.ndarray:
    """Returns the fixed table of contexts on which methods are compared, float64 ``[60, objects, 3]``.

    The table (``evaluation_contexts.json``) never changes. For a task that is not in it, contexts are drawn with
    a seed derived from its name.
    """
    task = get_task(task)
    rows = json.loads(TABLE.read_text())["contexts"].get(task.source)
    if rows is None:  # not D3IL's: the same ones every time
        return draw_contexts(task, NUM_EVALUATION_CONTEXTS, np.random.default_rng([*task.source.encode()]))
    return np.array(rows)


def check_contexts(task: Task, contexts) -> np.ndarray:
    """Returns contexts ``[C, objects, 3]`` in float64.

    Raises a ValueError for objects outside their regions, or in the same one of ``Scene.shared_starts``.
    """
    scene, contexts = _scene(task), np.asarray(contexts, dtype=np.float64)
    if contexts.ndim != 3 or contexts.shape[1:] != (len(task.objects), 3) or not len(contexts):
        raise ValueError(
            f"contexts of task {task.name!r} must be [C, {len(task.objects)}, 3] (x, y in m, yaw in rad for"
            f" {', '.join(task.objects)}), got shape {list(contexts.shape)}"
        )
    if not np.isfinite(contexts).all():
        raise ValueError(f"contexts must be finite; row {int(np.argwhere(~np.isfinite(contexts))[0][0])} is not")
    taken = np.zeros((len(contexts), len(scene.shared_starts)), int)  # objects that lie in this region alone
    for index, name in enumerate(task.objects):
        regions = scene.starts_of(index)
        low, high = (np.array([[bound[side] for bound in region] for region in regions]) for side in (0, 1))
        xy = contexts[:, None, index, :2]
        inside = ((xy >= low - _SLACK) & (xy <= high + _SLACK)).all(-1)  # [C, regions]
        if not inside.any(-1).all():
            row = int(np.flatnonzero(~inside.any(-1))[0])
            x, y = contexts[row, index, :2]
            ranges = " or ".join(f"x {r[0][0]}..{r[0][1]}, y {r[1][0]}..{r[1][1]}" for r in regions)
            raise ValueError(f"context {row} puts {name!r} at ({x:.4g}, {y:.4g}) m, outside its region: {ranges}")
        if scene.shared_starts:
            taken += inside & (inside.sum(-1, keepdims=True) == 1)
    if (taken > 1).any():
        row, region = np.argwhere(taken > 1)[0]
        x, y = scene.shared_starts[region]
        ranges = f"x {x[0]}..{x[1]}, y {y[0]}..{y[1]}"
        raise ValueError(f"context {row} puts {taken[row, region]} objects into one region: {ranges}")
    return contexts


def load_contexts(file: str | Path, task: Task | str) -> np.ndarray:
    """Reads D3IL's own context file, a pickled list of contexts, as float64 ``[C, objects, 3]``; refuses other content.

    Degrees become rad, and further entries are left out. The restricted unpickler reads the file.
    """
    task = get_task(task)
    contexts = load_pickle(Path(file))
    if not isinstance(contexts, (list, tuple)) or not contexts:
        raise ValueError(f"{file}: wanted a list of contexts, got {type(contexts).__name__}")
    rows = []
    for index, context in enumerate(contexts):
        poses = [array for array in _arrays(context) if array.shape == (3,)]
        if len(poses) < len(task.objects):
            raise ValueError(
                f"{file}: context {index} places {len(poses)} objects, task {task.name!r} has {len(task.objects)}"
            )
        rows.append([(x, y, math.radians(degrees)) for x, y, degrees in poses[: len(task.objects)]])
    try:
        return check_contexts(task, rows)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def _arrays(nested) -> list[np.ndarray]:
    """Returns the position and quaternion arrays of a context in order, however deep D3IL nests them."""
    if isinstance(nested, np.ndarray) and nested.dtype == object:
        nested = nested.tolist()
    if isinstance(nested, (list, tuple)) and any(isinstance(item, (list, tuple)) or np.ndim(item) for item in nested):
        return [array for item in nested for array in _arrays(item)]
    return [np.asarray(nested, dtype=np.float64)]


def yaw_quaternions(yaw: np.ndarray) -> np.ndarray:
    """Computes quaternions ``[..., 4]`` (w, x, y, z) of rotations about z by ``yaw`` (rad)."""
    half, zero = np.asarray(yaw) / 2, np.zeros(np.shape(yaw))
    return np.stack([np.cos(half), zero, zero, np.sin(half)], -1)


def poses_of(contexts: np.ndarray, height: float) -> np.ndarray:
    """Computes positions (m) and quaternions (w, x, y, z), ``[..., objects, 7]``, of objects at one ``height``."""
    level = np.full((*contexts.shape[:-1], 1), height)
    return np.concatenate([contexts[..., :2], level, yaw_quaternions(contexts[..., 2])], -1)
