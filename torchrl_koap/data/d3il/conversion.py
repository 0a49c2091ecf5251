# This source code is licensed under the MIT license found in the LICENSE file.
"""From a folder of D3IL's raw pickles to flat trajectories (docs/d3il.md, Recordings).

``Task.converter`` names the :class:`Converter` of a task.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from tensordict import TensorDictBase

from torchrl_koap.data.d3il.raw import RawEpisode, RawEpisodeError, read_raw_episode
from torchrl_koap.data.d3il.unpickling import load_pickle
from torchrl_koap.data.trajectories import flatten_trajectories
from torchrl_koap.lookup import resolve
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.tasks.action_rules import gripper_command
from torchrl_koap.tasks.features import tan_yaw

SPLITS = ("train", "eval")
_NO_EPISODES = ("*_files.pkl", "*_files_*.pkl", "*_contexts.pkl", "*_mode_prob.pkl")


@dataclass(frozen=True)
class Converter:
    """How the raw episodes of one task become observations and actions.

    Args:
        robot (tuple of str): entries of ``robot`` that are read.
        objects (tuple of str): logged objects whose pose is read, in the order of ``Task.objects``.
        folder (str): where D3IL keeps the files, seen from its data folder.
        convert (callable): from a raw episode of ``T`` rows to observations ``[T, obs]`` and actions ``[T - 1, act]``,
            as float64 arrays.
        unread (tuple of str): objects that may be logged as well and are not read.

    Examples:
        >>> from torchrl_koap.data.d3il.conversion import AVOIDING
        >>> AVOIDING.robot, AVOIDING.folder
        (('des_c_pos', 'c_pos'), 'avoiding/data')
    """

    robot: tuple[str, ...]
    objects: tuple[str, ...]
    folder: str
    convert: Callable[[RawEpisode], tuple[np.ndarray, np.ndarray]]
    unread: tuple[str, ...] = ()


def _robot(episode: RawEpisode, name: str) -> np.ndarray:
    return np.asarray(episode.robot[name], dtype=np.float64)


def _pose(episode: RawEpisode, name: str) -> tuple[np.ndarray, np.ndarray]:
    logged = episode.objects[name]
    return np.asarray(logged["pos"], dtype=np.float64), np.asarray(logged["quat"], dtype=np.float64)


def _avoiding(episode: RawEpisode) -> tuple[np.ndarray, np.ndarray]:
    desired, measured = _robot(episode, "des_c_pos")[:, :2], _robot(episode, "c_pos")[:, :2]
    return np.concatenate([desired, measured], axis=1), np.diff(desired, axis=0)


def _aligning(episode: RawEpisode) -> tuple[np.ndarray, np.ndarray]:
    desired = _robot(episode, "des_c_pos")
    poses = [part for name in ALIGNING.objects for part in _pose(episode, name)]
    return np.concatenate([desired, _robot(episode, "c_pos"), *poses], axis=1), np.diff(desired, axis=0)


def _sorting(episode: RawEpisode, boxes: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    frames, actions = _avoiding(episode)
    for name in boxes:
        position, quat = _pose(episode, name)
        frames = np.concatenate([frames, position[:, :2], tan_yaw(quat)[:, None]], axis=1)
    return frames, actions


def _stacking(episode: RawEpisode) -> tuple[np.ndarray, np.ndarray]:
    desired, width = _robot(episode, "des_j_pos"), _robot(episode, "gripper_width")[:, None]
    columns = [desired, width]
    for name in STACKING.objects:
        position, quat = _pose(episode, name)
        columns += [position, tan_yaw(quat)[:, None]]
    columns += [_robot(episode, "j_pos"), width, _robot(episode, "c_pos")]
    number = gripper_command(torch.from_numpy(width[:, 0])).numpy()[:, None]
    actions = np.concatenate([np.diff(desired, axis=0), number], axis=1)
    return np.concatenate(columns, axis=1), actions


def _sorting_converter(num_boxes: int) -> Converter:
    boxes = tuple(f"{colour}-box{index + 1}" for colour in ("red", "blue") for index in range(num_boxes // 2))
    folder = f"sorting/{num_boxes}_boxes/state"
    return Converter(("des_c_pos", "c_pos"), boxes, folder, partial(_sorting, boxes=boxes))


AVOIDING = Converter(("des_c_pos", "c_pos"), (), "avoiding/data", _avoiding)
ALIGNING = Converter(("des_c_pos", "c_pos"), ("push-box", "target-box"), "aligning/all_data/state", _aligning)
SORTING_2, SORTING_4, SORTING_6 = (_sorting_converter(num_boxes) for num_boxes in (2, 4, 6))
STACKING = Converter(
    robot=("des_j_pos", "j_pos", "gripper_width", "c_pos"),
    objects=("red-box", "green-box", "blue-box"),
    folder="stacking/all_data",
    convert=_stacking,
    unread=("target-box",),  # it never moves
)


class RawFolderError(ValueError):
    """A folder of demonstrations that cannot be used; ``problems`` lists those of all its files."""

    def __init__(self, folder: Path, problems: list[str]):
        self.problems = problems
        super().__init__(f"{len(problems)} problem(s) in {folder}:\n  - " + "\n  - ".join(problems))


def find_raw_files(task: str, root: str | Path, *, split_file: str | Path | None = None) -> tuple[Path, list[Path]]:
    """Finds the raw demonstrations of a task.

    Args:
        task (str): name of the task.
        root (str or Path): the folder of the pickles or one above it.
        split_file (str or Path, optional): a pickled list of file names, looked for in ``root``, in the folder of the
            pickles and in the two above it, where D3IL keeps its lists. ``"train"`` and ``"eval"`` stand for D3IL's
            own: ``train_files.pkl``, in Sorting ``4_boxes_train_files.pkl``.

    Returns:
        tuple: the folder, and its files in the order of their names.

    Raises:
        FileNotFoundError: if nothing is there; the message lists the places looked at.
        ValueError: if the split file is no list of plain file names.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data import RawEpisode, find_raw_files, write_raw_episode
        >>> path = np.linspace([0.5, -0.3, 0.12], [0.5, 0.4, 0.12], 40)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "env_000_00.pkl"
        ...     write_raw_episode(file, RawEpisode(robot={"des_c_pos": path, "c_pos": path}))
        ...     [path.name for path in find_raw_files("avoiding", folder)[1]]
        ['env_000_00.pkl']
    """
    root, inside = Path(root).expanduser(), PurePosixPath(get_converter(task).folder).parts
    ends = [Path(*inside[start:]) for start in range(len(inside) - 1, -1, -1)]
    places = [root, *(root / end for end in ends), root / "environments/dataset/data" / ends[-1]]
    for folder in places:
        files = _pickles(folder)
        if files:
            break
    else:
        if not root.is_dir():
            raise FileNotFoundError(f"no folder {root}")
        raise FileNotFoundError("no demonstrations (*.pkl) in " + ", ".join(map(str, places)))
    if split_file is not None:
        above = [root, folder, folder.parent, folder.parent.parent]
        if split_file in SPLITS:
            lists = [f"{part}_{split_file}_files.pkl" for part in inside] + [f"{split_file}_files.pkl"]
            names = _read_split([place / name for place in above for name in lists])
        else:
            names = _read_split([Path(split_file), *(place / split_file for place in above)])
        files = [folder / name for name in names]
        absent = [file.name for file in files if not file.is_file()]
        if absent:
            raise FileNotFoundError(f"{folder} lacks {len(absent)} files of {split_file}: {', '.join(absent[:10])}")
    return folder, files


def convert_raw_files(
    converter: Converter,
    files: Sequence[Path],
    folder: Path,
    *,
    dtype: torch.dtype = torch.float32,
    progress: Callable[[int, int], None] | None = None,
) -> TensorDictBase:
    """Converts raw demonstrations to flat TED data.

    Args:
        converter (Converter): that of the task.
        files (sequence of Path): the demonstrations, one trajectory each.
        folder (Path): what to call the whole in an error message.
        dtype (torch.dtype): floating type of the entries.
        progress (callable, optional): called with the number of files read and that of all.

    Returns:
        TensorDictBase: flat data ``[N]``, one trajectory per file.

    Raises:
        RawFolderError: with the problems of all files.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data import RawEpisode, convert_raw_files, write_raw_episode
        >>> from torchrl_koap.data.d3il.conversion import get_converter
        >>> path = np.linspace([0.5, -0.3, 0.12], [0.5, 0.4, 0.12], 40)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     file = Path(folder) / "env_000_00.pkl"
        ...     write_raw_episode(file, RawEpisode(robot={"des_c_pos": path, "c_pos": path}))
        ...     data = convert_raw_files(get_converter("avoiding"), [file], Path(folder))
        >>> data["observation"].shape, data["action"].shape
        (torch.Size([39, 4]), torch.Size([39, 2]))
    """
    observations, actions = [], []
    for frames, steps in read_trajectories(converter, files, folder, progress=progress):
        observations.append(frames.to(dtype))
        actions.append(steps.to(dtype))
    return flatten_trajectories(observations, actions, dtype=dtype)


def read_trajectories(
    converter: Converter, files: Sequence[Path], folder: Path, *, progress: Callable[[int, int], None] | None = None
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Reads raw demonstrations one by one, each when it is asked for.

    Args:
        converter (Converter): that of the task.
        files (sequence of Path): the demonstrations, one trajectory each.
        folder (Path): what to call the whole in an error message.

    Keyword Args:
        progress (callable, optional): called with the number of files read and that of all.

    Yields:
        tuple: frames ``[T, obs]`` and actions ``[T - 1, act]``, float64; none behind a file that has a problem.

    Raises:
        RawFolderError: at the end, with the problems of all files.
    """
    problems: list[str] = []
    for index, file in enumerate(files):
        if progress is not None and index:
            progress(index, len(files))
        try:
            episode = read_raw_episode(file, robot=converter.robot, objects=converter.objects)
        except RawEpisodeError as error:
            problems += _other_task(file, converter) or error.problems
            continue
        except OSError as error:
            problems.append(f"{file}: cannot be read: {error}")
            continue
        if not _logs(episode, converter):
            problems.append(_origin(file, episode, converter))
            continue
        if not problems:
            observation, action = converter.convert(episode)
            yield torch.from_numpy(observation), torch.from_numpy(action)
    if problems:
        raise RawFolderError(folder, problems)


def get_converter(task: str) -> Converter:
    """Looks up how raw episodes of a task are converted.

    Args:
        task (str): name of the task.

    Raises:
        ValueError: if the task is unknown, or no converter is known for it.
    """
    facts = get_task(get_task(task).source)
    if facts.converter is None:
        raise ValueError(f"task {task!r} names no converter of D3IL's raw pickles; its data are TED or LeRobot folders")
    return resolve(facts.converter, f"converter of task {task!r}")


def _converters() -> dict[str, Converter]:
    own = [task.name for task in TASKS.values() if task.converter is not None and not task.data]
    return {name: get_converter(name) for name in own}


def _other_task(file: Path, converter: Converter) -> list[str]:
    """Of a file that lacks something: the one problem that explains it all if it belongs to another task, else none."""
    try:
        episode = read_raw_episode(file)
    except RawEpisodeError:
        return []
    known = not _logs(episode, converter) and any(_logs(episode, other) for other in _converters().values())
    return [_origin(file, episode, converter)] if known else []


def _origin(file: Path, episode: RawEpisode, converter: Converter) -> str:
    logged = ", ".join(map(str, episode.objects)) or "no objects"
    others = [task for task, other in _converters().items() if _logs(episode, other)]
    origin = f"a demonstration of {others[0]!r}" if others else "of an unknown task"
    return f"{file}: {origin}: it logs {logged}, wanted {', '.join(converter.objects) or 'no objects'}"


def _logs(episode: RawEpisode, converter: Converter) -> bool:
    logged = set(episode.objects)
    return set(converter.objects) in (logged, logged - {*converter.unread})


def _pickles(folder: Path) -> list[Path]:
    """The demonstrations of a folder in the order of their names, without D3IL's lists of files and contexts."""
    return [
        file
        for file in sorted(folder.glob("*.pkl"))
        if not file.name.startswith(".") and not any(fnmatch.fnmatch(file.name, other) for other in _NO_EPISODES)
    ]


def _read_split(places: Sequence[Path]) -> list[str]:
    for file in places:
        if file.is_file():
            break
    else:
        raise FileNotFoundError("no split file at " + ", ".join(map(str, places)))
    names = load_pickle(file)
    names = names.tolist() if isinstance(names, np.ndarray) else names
    if not isinstance(names, (list, tuple)) or not names:
        raise ValueError(f"{file}: a split file is a list of file names, got {type(names).__name__}")
    for name in names:
        if not isinstance(name, str) or PurePosixPath(name).name != name:
            raise ValueError(f"{file}: {name!r} is no plain file name")
    return sorted(set(names))
