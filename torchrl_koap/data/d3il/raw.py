# This source code is licensed under the MIT license found in the LICENSE file.
"""One demonstration in D3IL's raw layout: read with checks, written for other tools.

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

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.d3il.pickle_scan import DamagedPickleError, UnsafePickleError
from torchrl_koap.data.d3il.unpickling import load_pickle
from torchrl_koap.files import replacing_file

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


class RawEpisodeError(ValueError):
    """A demonstration that cannot be used; ``problems`` lists every fault found, each with file and key."""

    def __init__(self, problems: list[str]):
        self.problems = problems
        super().__init__("; ".join(problems))


@dataclass(frozen=True)
class RawEpisode:
    """One recorded demonstration of ``T`` control steps.

    Args:
        robot (dict): arrays ``[T, ...]`` by name, see the module's table.
        objects (dict): for each object of the scene its arrays ``[T, ...]`` by name.
        context (optional): what the scene was reset to, plain containers and arrays.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data.d3il.raw import RawEpisode
        >>> episode = RawEpisode(robot={"des_c_pos": np.zeros((40, 3)), "c_pos": np.zeros((40, 3))})
        >>> len(episode), episode.objects
        (40, {})
    """

    robot: Mapping[str, np.ndarray]
    objects: Mapping[str, Mapping[str, np.ndarray]] = field(default_factory=dict)
    context: Any = None

    def __len__(self) -> int:
        return len(next(iter(self.robot.values())))


def read_raw_episode(
    path: str | Path, *, robot: Sequence[str] = (), objects: Sequence[str] = (), min_length: int = 2
) -> RawEpisode:
    """Reads and checks one demonstration.

    Args:
        path (str or Path): a pickle in D3IL's raw layout; read by the restricted unpickler.
        robot (sequence of str): entries of ``robot`` that must be there.
        objects (sequence of str): objects that must be there, with ``pos`` and ``quat``.
        min_length (int): least number of rows.

    Returns:
        RawEpisode: its arrays, a row per control step.

    Raises:
        RawEpisodeError: with all problems: unsafe or damaged file, missing keys, wrong shapes, unequal lengths, NaN or
            infinite values, too few rows. Each names file and key.
        FileNotFoundError: if there is no such file.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data.d3il.raw import RawEpisode, read_raw_episode, write_raw_episode
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "env_000_00.pkl"
        ...     write_raw_episode(path, RawEpisode(robot={"c_pos": np.zeros((5, 3))}))
        ...     len(read_raw_episode(path, robot=["c_pos"]))
        5
    """
    path = Path(path)
    try:
        content = load_pickle(path)
    except (UnsafePickleError, DamagedPickleError) as error:
        raise RawEpisodeError([str(error)]) from error
    if not isinstance(content, dict) or not isinstance(content.get("robot"), dict):
        held = f"the keys {sorted(map(str, content))}" if isinstance(content, dict) else f"a {type(content).__name__}"
        raise RawEpisodeError([f"{path}: missing key 'robot' (a dictionary of arrays); the file holds {held}"])
    episode = RawEpisode(
        robot=content["robot"],
        objects={key: value for key, value in content.items() if key not in ("robot", "context")},
        context=content.get("context"),
    )
    problems = _problems(episode, robot=robot, objects=objects, min_length=min_length)
    if problems:
        raise RawEpisodeError([f"{path}: {problem}" for problem in problems])
    return episode


def write_raw_episode(path: str | Path, episode: RawEpisode) -> None:
    """Writes one demonstration as D3IL would have logged it, so that other tools can read it.

    This is the one place where the library writes a pickle: plain dictionaries of arrays. The file appears complete
    or not at all.

    Args:
        path (str or Path): file to create or replace.
        episode (RawEpisode): the demonstration; checked like a file that is read.

    Raises:
        RawEpisodeError: with all problems of the demonstration.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data import RawEpisode, load_pickle, write_raw_episode
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "env_000_00.pkl"
        ...     write_raw_episode(path, RawEpisode(robot={"c_pos": np.zeros((5, 3))}))
        ...     load_pickle(path)["robot"]["c_pos"].shape
        (5, 3)
    """
    problems = _problems(episode, robot=(), objects=(), min_length=1)
    if problems:
        raise RawEpisodeError([f"{path}: {problem}" for problem in problems])
    content = {
        "context": episode.context,
        "robot": {key: np.ascontiguousarray(value) for key, value in episode.robot.items()},
        **{
            name: {key: np.ascontiguousarray(value) for key, value in entries.items()}
            for name, entries in episode.objects.items()
        },
    }
    with replacing_file(path) as aside, open(aside, "wb") as file:
        pickle.dump(content, file, protocol=4)


def _problems(episode: RawEpisode, *, robot, objects, min_length) -> list[str]:
    problems = []
    tables: list[tuple[str, Any, Mapping, Sequence[str]]] = [("robot", episode.robot, ROBOT_COLUMNS, robot)]
    for name in (*episode.objects, *(name for name in objects if name not in episode.objects)):
        needed = ("pos", "quat") if name in objects else ()
        tables.append((name, episode.objects.get(name), OBJECT_COLUMNS, needed))

    lengths = {}
    for name, entries, columns, required in tables:
        if not isinstance(entries, Mapping):
            problems.append(f"missing key '{name}'" if entries is None else f"'{name}' is no dictionary of arrays")
            continue
        problems += [f"missing key '{name}/{key}'" for key in required if key not in entries]
        for key, value in entries.items():
            if key not in columns:  # an entry that this library knows nothing about
                continue
            problem = _array_problem(value, columns[key])
            if problem:
                problems.append(f"'{name}/{key}' {problem}")
            else:
                lengths[f"{name}/{key}"] = len(value)

    if len(set(lengths.values())) > 1:
        counts = ", ".join(f"{key} {length}" for key, length in lengths.items())
        problems.append(f"unequal lengths: {counts}")
    elif not lengths:
        if not problems:  # else the faults of the arrays say more
            problems.append("'robot' holds none of the known arrays: " + ", ".join(ROBOT_COLUMNS))
    elif min(lengths.values()) < min_length:
        problems.append(f"too short: {min(lengths.values())} rows, at least {min_length} are needed")
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
        row = int(np.argwhere(bad)[0][0])
        return f"is NaN or infinite in {int(bad.sum())} values, first in row {row}"
    return None
