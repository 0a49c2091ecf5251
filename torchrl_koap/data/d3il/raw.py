# This source code is licensed under the MIT license found in the LICENSE file.
"""One demonstration in D3IL's raw layout, read with checks.

One pickle per demonstration (docs/d3il.md, Recordings), one row per control step, ``T`` rows::

    context                                              what the scene was reset to; None in Avoiding
    robot    c_pos, c_vel, des_c_pos            (T, 3)   measured velocity and pose, commanded pose of the end effector
             c_quat, des_c_quat                 (T, 4)
             j_pos, j_vel, des_j_pos, des_j_vel, des_j_acc   (T, 7)
             gripper_width, time_stamp, sim_step, wall_clock (T,)
    <object> pos (T, 3), quat (T, 4), sim_step (T,)      one entry per object of the scene

Rows are logged after the first substep of a control step: ``c_pos`` is the pose at the start of the step, ``des_c_pos``
the command of that step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.d3il.unpickling import load_pickle
from torchrl_koap.files import DataError

ROBOT_COLUMNS = {
    "time_stamp": (),
    "sim_step": (),
    "wall_clock": (),
    "j_pos": (7,),
    "j_vel": (7,),
    "c_pos": (3,),
    "c_vel": (3,),
    "c_quat": (4,),
    "des_c_pos": (3,),
    "des_c_quat": (4,),
    "des_j_pos": (7,),
    "des_j_vel": (7,),
    "des_j_acc": (7,),
    "gripper_width": (),
}
OBJECT_COLUMNS = {"sim_step": (), "pos": (3,), "quat": (4,)}
_LEAST_ROWS = 2


@dataclass(frozen=True)
class RawEpisode:
    """One recorded demonstration of ``T`` control steps.

    Args:
        robot (mapping): arrays ``[T, ...]`` by name, see the module's table.
        objects (mapping): for each object of the scene its arrays ``[T, ...]`` by name.
    """

    robot: Mapping[str, np.ndarray]
    objects: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)


def read_raw_episode(path: str | Path, *, robot: Sequence[str] = (), objects: Sequence[str] = ()) -> RawEpisode:
    """Reads and checks a pickle, in which entries ``robot`` and poses of ``objects`` must be there.

    Raises:
        DataError: with all problems.
    """
    content = load_pickle(path)
    if not isinstance(content, dict) or not isinstance(content.get("robot"), dict):
        held = f"the keys {sorted(map(str, content))}" if isinstance(content, dict) else f"a {type(content).__name__}"
        raise DataError(path, f"missing key 'robot' (a dictionary of arrays); the file holds {held}")
    others = {key: value for key, value in content.items() if key not in ("robot", "context")}
    problems = _problems(content["robot"], others, robot=robot, objects=objects)
    if problems:
        raise DataError(path, problems)
    return RawEpisode(content["robot"], others)


def _problems(robot_arrays, object_arrays, *, robot: Sequence[str], objects: Sequence[str]) -> list[str]:
    problems = []
    tables: list[tuple[str, Any, Mapping, Sequence[str]]] = [("robot", robot_arrays, ROBOT_COLUMNS, robot)]
    for name in dict.fromkeys((*object_arrays, *objects)):
        needed = ("pos", "quat") if name in objects else ()
        tables.append((name, object_arrays.get(name), OBJECT_COLUMNS, needed))
    lengths = {}
    for name, entries, columns, required in tables:
        if not isinstance(entries, Mapping):
            problems.append(f"missing key '{name}'" if entries is None else f"'{name}' is no dictionary of arrays")
            continue
        problems += [f"missing key '{name}/{key}'" for key in required if key not in entries]
        for key in (key for key in columns if key in entries):  # others this library knows nothing about
            problem = _array_problem(entries[key], columns[key])
            if problem:
                problems.append(f"'{name}/{key}' {problem}")
            else:
                lengths[f"{name}/{key}"] = len(entries[key])
    if len(set(lengths.values())) > 1:
        problems.append(f"unequal lengths: {', '.join(f'{key} {length}' for key, length in sorted(lengths.items()))}")
    elif not lengths and not problems:  # else the faults of the arrays say more
        problems.append("'robot' holds none of the known arrays: " + ", ".join(ROBOT_COLUMNS))
    elif lengths and min(lengths.values()) < _LEAST_ROWS:
        problems.append(f"too short: {min(lengths.values())} rows, at least {_LEAST_ROWS} are needed")
    return problems


def _array_problem(value: Any, shape: tuple[int, ...]) -> str | None:
    wanted = "(T" + "".join(f", {size}" for size in shape) + ("," if not shape else "") + ")"
    if not isinstance(value, np.ndarray):
        return f"must be an array {wanted}, got {type(value).__name__}"
    if value.dtype.kind not in "iuf":
        return f"must hold real numbers, got dtype {value.dtype}"
    if value.ndim != 1 + len(shape) or value.shape[1:] != shape:
        return f"must have shape {wanted}, got {value.shape}"
    bad = ~np.isfinite(value)
    if bad.any():
        return f"is NaN or infinite in {int(bad.sum())} values, first in row {int(np.argwhere(bad)[0][0])}"
    return None
