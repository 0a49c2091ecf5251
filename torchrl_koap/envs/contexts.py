# This source code is licensed under the MIT license found in the LICENSE file.
"""Contexts: where the objects of a task lie when an episode begins (spec section 6).

A context is ``[objects, 3]``: x, y (m) and yaw (rad) of every object of ``Task.objects``. They come from a seeded
generator (:func:`draw_contexts`), from the fixed table on which methods are compared (:func:`evaluation_contexts`), or
from D3IL's own files (:func:`load_contexts`).
"""

from __future__ import annotations

import functools
import json
import math
from pathlib import Path

import numpy as np

from torchrl_koap.data.d3il.unpickling import load_pickle
from torchrl_koap.tasks import Task, get_task

TABLE = Path(__file__).with_name("evaluation_contexts.json")
NUM_EVALUATION_CONTEXTS = 60
_YAW = (-90.0, 90.0)  # deg
_SLACK = 1e-6  # D3IL keeps contexts in float32

# x range, y range (m) of every object; Sorting deals six regions out to its boxes at random
_SORTING_REGIONS = tuple((x, y) for x in ((0.4, 0.5), (0.55, 0.65)) for y in ((-0.15, -0.1), (-0.05, 0.0), (0.05, 0.1)))
_REGIONS = {
    "aligning": (((0.4, 0.6), (-0.25, -0.1)), ((0.4, 0.6), (0.2, 0.35))),
    "stacking": (((0.35, 0.45), (-0.25, -0.15)), ((0.35, 0.45), (-0.1, 0.0)), ((0.55, 0.6), (-0.2, 0.0))),
}


def _family(task: Task) -> str:
    """Tasks of one family place their objects alike."""
    if not task.objects:
        raise ValueError(f"task {task.name!r} has no contexts: every episode starts the same")
    return task.name.removeprefix("po_").partition("_")[0]


def draw_contexts(task: Task | str, num: int, generator: np.random.Generator | int | None = None) -> np.ndarray:
    """Random contexts from the ranges of a task.

    Args:
        task (Task or str): the task.
        num (int): number of contexts.
        generator (np.random.Generator or int, optional): random generator or seed.

    Returns:
        np.ndarray: float64 ``[num, objects, 3]``: x, y (m), yaw (rad).

    Raises:
        ValueError: if the task is unknown or has no contexts, or the number is below 1.

    Examples:
        >>> from torchrl_koap.envs.contexts import draw_contexts
        >>> draw_contexts("sorting", 5, 0).shape
        (5, 4, 3)
    """
    task = get_task(task) if isinstance(task, str) else task
    family = _family(task)
    if num < 1:
        raise ValueError(f"the number of contexts must be at least 1, got {num}")
    generator = np.random.default_rng(generator)
    contexts = np.empty((num, len(task.objects), 3))
    for context in contexts:
        regions = _REGIONS.get(family)
        if regions is None:
            regions = [_SORTING_REGIONS[index] for index in generator.permutation(len(_SORTING_REGIONS))]
        for row, (x, y) in zip(context, regions, strict=False):
            row[:] = generator.uniform(*x), generator.uniform(*y), math.radians(generator.uniform(*_YAW))
    return contexts


@functools.cache
def _table() -> dict:
    return json.loads(TABLE.read_text())


def evaluation_contexts(task: Task | str, num: int = NUM_EVALUATION_CONTEXTS) -> np.ndarray:
    """The first contexts of the fixed table on which two methods meet the same situations.

    The table (``evaluation_contexts.json``, with a version number) never changes; a new one gets a new number.

    Args:
        task (Task or str): the task.
        num (int): how many, at most 60.

    Returns:
        np.ndarray: float64 ``[num, objects, 3]``.

    Raises:
        ValueError: if the task is unknown or has no contexts, or more are asked for than the table holds.

    Examples:
        >>> from torchrl_koap.envs.contexts import evaluation_contexts
        >>> evaluation_contexts("aligning").shape
        (60, 2, 3)
    """
    task = get_task(task) if isinstance(task, str) else task
    _family(task)
    rows = _table()["contexts"][task.source]
    if not 1 <= num <= len(rows):
        raise ValueError(f"the table holds {len(rows)} contexts of task {task.name!r}, asked for {num}")
    return np.array(rows[:num])


def check_contexts(task: Task, contexts) -> np.ndarray:
    """Contexts as an array, or an error that names what is wrong with them.

    Raises:
        ValueError: if the task has none, the shape is not ``[C, objects, 3]``, or an object lies where the task never
            puts it.
    """
    family, contexts = _family(task), np.asarray(contexts, dtype=np.float64)
    if contexts.ndim != 3 or contexts.shape[1:] != (len(task.objects), 3) or not len(contexts):
        raise ValueError(
            f"contexts of task {task.name!r} must be [C, {len(task.objects)}, 3] (x, y in m, yaw in rad for"
            f" {', '.join(task.objects)}), got shape {list(contexts.shape)}"
        )
    if not np.isfinite(contexts).all():
        raise ValueError(f"contexts must be finite; row {int(np.argwhere(~np.isfinite(contexts))[0][0])} is not")
    for index, name in enumerate(task.objects):
        regions = _REGIONS[family][index : index + 1] if family in _REGIONS else _SORTING_REGIONS
        low, high = (np.array([[bound[side] for bound in region] for region in regions]) for side in (0, 1))
        xy = contexts[:, None, index, :2]
        inside = ((xy >= low - _SLACK) & (xy <= high + _SLACK)).all(-1).any(-1)
        if not inside.all():
            row = int(np.flatnonzero(~inside)[0])
            x, y = contexts[row, index, :2]
            ranges = " or ".join(f"x {r[0][0]}..{r[0][1]}, y {r[1][0]}..{r[1][1]}" for r in regions)
            raise ValueError(f"context {row} puts {name!r} at ({x:.4g}, {y:.4g}) m, outside its region: {ranges}")
    return contexts


def load_contexts(file: str | Path, task: Task | str) -> np.ndarray:
    """Reads D3IL's own context file: a pickled list of contexts.

    Args:
        file (str or Path): the pickle; read by the restricted unpickler.
        task (Task or str): the task.

    Returns:
        np.ndarray: float64 ``[C, objects, 3]``; D3IL's degrees become rad, its further entries are left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file does not hold contexts of this task.
    """
    task = get_task(task) if isinstance(task, str) else task
    _family(task)
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
    """The position and quaternion arrays of a context, in order, however deep D3IL nests them."""
    if isinstance(nested, np.ndarray) and nested.dtype == object:
        nested = nested.tolist()
    if isinstance(nested, (list, tuple)) and any(isinstance(item, (list, tuple)) or np.ndim(item) for item in nested):
        return [array for item in nested for array in _arrays(item)]
    return [np.asarray(nested, dtype=np.float64)]


def yaw_quaternions(yaw: np.ndarray) -> np.ndarray:
    """Quaternions ``[..., 4]`` (w, x, y, z) of rotations about z by ``yaw`` (rad)."""
    half, zero = np.asarray(yaw) / 2, np.zeros(np.shape(yaw))
    return np.stack([np.cos(half), zero, zero, np.sin(half)], -1)


def poses_of(contexts: np.ndarray, height: float) -> np.ndarray:
    """Poses ``[..., objects, 7]`` of objects that contexts ``[..., objects, 3]`` place at a height (m)."""
    level = np.full((*contexts.shape[:-1], 1), height)
    return np.concatenate([contexts[..., :2], level, yaw_quaternions(contexts[..., 2])], -1)
