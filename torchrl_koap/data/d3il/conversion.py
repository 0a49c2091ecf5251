# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts D3IL's raw pickles to trajectories (docs/appendix/d3il.md, Recordings), by the task in :data:`CONVERTERS`.

One pickle per demonstration, one row per control step, ``T`` rows::

    context                                              initial scene of the episode; None in Avoiding
    robot    c_pos, c_vel, des_c_pos            (T, 3)   measured velocity and pose, commanded pose of the end effector
             c_quat, des_c_quat                 (T, 4)
             j_pos, j_vel, des_j_pos, des_j_vel, des_j_acc   (T, 7)
             gripper_width, time_stamp, sim_step, wall_clock (T,)
    <object> pos (T, 3), quat (T, 4), sim_step (T,)      one entry per object of the scene

Rows are logged after the first substep of a control step: ``c_pos`` is the pose at the start of the step, ``des_c_pos``
the command of that step.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch

from torchrl_koap.data.d3il.unpickling import load_pickle
from torchrl_koap.files import DataError, refuse
from torchrl_koap.tasks.action_rules import gripper_command
from torchrl_koap.tasks.columns import tan_yaw

ROBOT_COLUMNS: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("time_stamp", "sim_step", "wall_clock", "gripper_width"), ()),
    **dict.fromkeys(("j_pos", "j_vel", "des_j_pos", "des_j_vel", "des_j_acc"), (7,)),
    **dict.fromkeys(("c_pos", "c_vel", "des_c_pos"), (3,)),
    **dict.fromkeys(("c_quat", "des_c_quat"), (4,)),
}
OBJECT_COLUMNS = {"sim_step": (), "pos": (3,), "quat": (4,)}
_LEAST_ROWS = 2
_UNIT = 0.01  # tolerance of a quaternion's norm, as of other recordings
_NO_EPISODES = ("*_files.pkl", "*_files_*.pkl", "*_contexts.pkl", "*_mode_prob.pkl")


Robot = Mapping[str, np.ndarray]  # entries of ``robot``, or of an object, [T, ...] by name
Poses = Sequence[tuple[np.ndarray, np.ndarray]]  # positions [T, 3] and quaternions [T, 4] of every object


@dataclass(frozen=True)
class Converter:
    """Converts the raw episodes of one task to observations and actions."""

    robot: tuple[str, ...]  # entries of ``robot`` to read
    objects: tuple[str, ...]  # logged objects whose pose to read, in the order of ``Task.objects``
    folder: str  # of the files, relative to D3IL's data folder
    columns: Callable[[Robot, Poses], tuple[np.ndarray, np.ndarray]]  # to observations and actions
    unread: tuple[str, ...] = ()  # objects that may be logged too, and are ignored

    def convert(self, robot: Robot, objects: Mapping[str, Robot]) -> tuple[np.ndarray, np.ndarray]:
        """Converts the ``T`` rows of an episode to observations ``[T, obs]`` and actions ``[T - 1, act]``, float64."""
        robot = {name: np.asarray(robot[name], dtype=np.float64) for name in self.robot}
        logged = [objects[name] for name in self.objects]
        poses = [(np.asarray(each["pos"], np.float64), np.asarray(each["quat"], np.float64)) for each in logged]
        return self.columns(robot, poses)


def _avoiding(robot: Robot, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    desired, measured = robot["des_c_pos"][:, :2], robot["c_pos"][:, :2]
    return np.concatenate([desired, measured], axis=1), np.diff(desired, axis=0)


def _aligning(robot: Robot, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    columns = [robot["des_c_pos"], robot["c_pos"], *(part for pose in poses for part in pose)]
    return np.concatenate(columns, axis=1), np.diff(robot["des_c_pos"], axis=0)


def _sorting(robot: Robot, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    frames, actions = _avoiding(robot, ())
    boxes = [part for position, quat in poses for part in (position[:, :2], tan_yaw(quat)[:, None])]
    return np.concatenate([frames, *boxes], axis=1), actions


def _stacking(robot: Robot, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    desired, width = robot["des_j_pos"], robot["gripper_width"][:, None]
    boxes = [part for position, quat in poses for part in (position, tan_yaw(quat)[:, None])]
    number = gripper_command(torch.tensor(width[:, 0])).numpy()[:, None]
    actions = np.concatenate([np.diff(desired, axis=0), number], axis=1)
    return np.concatenate([desired, width, *boxes, robot["j_pos"], width, robot["c_pos"]], axis=1), actions


def _sorting_converter(num_boxes: int) -> Converter:
    boxes = tuple(f"{colour}-box{index + 1}" for colour in ("red", "blue") for index in range(num_boxes // 2))
    return Converter(_HAND, boxes, f"sorting/{num_boxes}_boxes/state", _sorting)


_HAND = ("des_c_pos", "c_pos")
CONVERTERS = {
    "avoiding": Converter(_HAND, (), "avoiding/data", _avoiding),
    "aligning": Converter(_HAND, ("push-box", "target-box"), "aligning/all_data/state", _aligning),
    "sorting_2": _sorting_converter(2),
    "sorting": _sorting_converter(4),
    "sorting_6": _sorting_converter(6),
    "stacking": Converter(
        robot=("des_j_pos", "j_pos", "gripper_width", "c_pos"),
        objects=("red-box", "green-box", "blue-box"),
        folder="stacking/all_data",
        columns=_stacking,
        unread=("target-box",),  # it never moves
    ),
}


def find_raw_files(converter: Converter, root: str | Path) -> list[Path]:
    """Finds raw demonstrations below a folder in D3IL's layout, sorted by name.

    Raises:
        FileNotFoundError: if there are none; the message lists the searched folders.
    """
    root, inside = Path(root).expanduser(), PurePosixPath(converter.folder).parts
    ends = [Path(*inside[start:]) for start in range(len(inside) - 1, -1, -1)]
    folders = [root, *(root / end for end in ends), root / "environments/dataset/data" / ends[-1]]
    for folder in folders:
        found = [file for file in sorted(folder.glob("*.pkl")) if not file.name.startswith(".")]
        files = [file for file in found if not any(fnmatch.fnmatch(file.name, other) for other in _NO_EPISODES)]
        if files:
            return files
    searched = ", ".join(map(str, folders))
    raise FileNotFoundError(f"no data set of `koap convert` and no demonstrations of D3IL (*.pkl) in {searched}")


def read_raw(
    converter: Converter, root: str | Path, *, progress: Callable[[int, int], None] | None = None
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Reads raw demonstrations, one trajectory per file: frames ``[T, obs]`` and actions ``[T - 1, act]``, float64."""
    problems: list[str] = []
    frames: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    files = find_raw_files(converter, root)
    for index, file in enumerate(files):
        if progress is not None:
            progress(index, len(files))
        try:
            observed, acted = converter.convert(*_read_episode(file, converter))
        except DataError as error:
            problems += [f"{file}: {problem}" for problem in error.problems]
        except OSError as error:
            problems.append(f"{file}: cannot be read: {error}")
        else:
            frames.append(observed)
            actions.append(acted)
    refuse(root, problems)
    return frames, actions


def _read_episode(path: Path, converter: Converter) -> tuple[Robot, dict[str, Robot]]:
    """Reads the robot and the objects of a pickle; checks that it has the converter's entries and poses."""
    content = load_pickle(path)
    if not isinstance(content, dict) or not isinstance(content.get("robot"), dict):
        held = f"the keys {sorted(map(str, content))}" if isinstance(content, dict) else f"a {type(content).__name__}"
        raise DataError(path, f"missing key 'robot' (a dictionary of arrays); the file holds {held}")
    others = {key: value for key, value in content.items() if key not in ("robot", "context")}
    refuse(path, _problems(content["robot"], others, converter))
    if set(converter.objects) not in (set(others), {*others} - {*converter.unread}):
        wanted = ", ".join(converter.objects) or "no objects"
        raise DataError(path, f"of another task: it logs {', '.join(map(str, others))}, wanted {wanted}")
    return content["robot"], others


def _problems(robot: Mapping[str, Any], objects: Mapping[str, Any], converter: Converter) -> list[str]:
    problems = []
    tables: list[tuple[str, Any, Mapping, Sequence[str]]] = [("robot", robot, ROBOT_COLUMNS, converter.robot)]
    for name in dict.fromkeys((*objects, *converter.objects)):
        needed = ("pos", "quat") if name in converter.objects else ()
        tables.append((name, objects.get(name), OBJECT_COLUMNS, needed))
    lengths = {}
    for name, entries, columns, required in tables:
        if not isinstance(entries, Mapping):
            problems.append(f"missing key '{name}'" if entries is None else f"'{name}' is no dictionary of arrays")
            continue
        problems += [f"missing key '{name}/{key}'" for key in required if key not in entries]
        for key in (key for key in columns if key in entries):  # unknown entries are ignored
            problem = _array_problem(entries[key], columns[key])
            if problem is None and key == "quat" and key in required:
                problem = _rotation_problem(entries[key])
            if problem:
                problems.append(f"'{name}/{key}' {problem}")
            else:
                lengths[f"{name}/{key}"] = len(entries[key])
    if len(set(lengths.values())) > 1:
        problems.append(f"unequal lengths: {', '.join(f'{key} {length}' for key, length in sorted(lengths.items()))}")
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


def _rotation_problem(quaternions: np.ndarray) -> str | None:
    norms = np.linalg.norm(quaternions, axis=1)
    off = np.flatnonzero(np.abs(norms - 1) > _UNIT)
    return f"has norm {norms[off[0]]:.3g} in row {off[0]}, wanted 1 as of rotations" if len(off) else None
