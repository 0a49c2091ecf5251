# This source code is licensed under the MIT license found in the LICENSE file.
"""D3IL demonstrations kept as a LeRobot data set: which of its columns are a task's, and whether its actions fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl._utils import logger as torchrl_logger

from torchrl_koap.data.d3il.conversion import RawFolderError
from torchrl_koap.data.lerobot.files import LeRobotFolder, given_names, read_lerobot_folder
from torchrl_koap.data.trajectories import flatten_trajectories
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks import TASKS, Task, get_task

ACTIONS = ("delta", "absolute")
_SAME_COMMAND = 1e-4  # m or rad: far above rounding, far below a step of the hand


def column_names(task: Task) -> list[str]:
    """Names of a task's observation columns: the part's own, with a number if it has several columns.

    Examples:
        >>> from torchrl_koap.data.lerobot.reader import column_names
        >>> from torchrl_koap.tasks import get_task
        >>> column_names(get_task("sorting_2"))[2:7]
        ['measured_xy_0', 'measured_xy_1', 'red_1_xy_0', 'red_1_xy_1', 'red_1_tan_yaw']
    """
    return list(task.observation_names)


def read_lerobot(
    root: str | Path,
    task: str,
    *,
    actions: str = "delta",
    split: str | None = None,
    dtype: torch.dtype = torch.float32,
) -> TensorDictBase:
    """Reads a LeRobot data set of a D3IL task as flat TED data.

    The columns of the observation are ``observation.state`` and, if there, ``observation.environment_state`` behind it.
    If ``info.json`` names them as :func:`column_names` does, they may come in any order, and others are left out.
    Otherwise there must be as many as the task's observation has, in its order (for Avoiding, Aligning and Sorting that
    is D3IL's own order). Stacking needs the measured joints and the TCP position too, which D3IL's own 20 columns lack:
    such a set is refused.

    The desired position is part of every observation, so actions can be checked: each must lead from the desired
    position of its row to that of the next row. An episode of ``T`` rows makes ``T - 1`` steps; the action of the last
    row leads to a frame that was not recorded and is dropped.

    The public D3IL sets in v1.x (``krishpop/d3il_*``) have the columns of Avoiding and Sorting. Their converter reads
    quaternions in another order than D3IL writes them, so that ``tan(yaw)`` is that of another angle, near zero for a
    box that lies flat; a warning says so. ``po_sorting`` does not use it.

    Args:
        root (str or Path): the folder with ``meta`` and ``data``, of format v1.x, v2.x or v3.0.
        task (str): name of the task.
        actions (str): what the ``action`` column holds: ``"delta"``, changes of the desired position, or
            ``"absolute"``, desired positions (of the row or of the next one). Stacking's last entry is a gripper width
            in either case.
        split (str, optional): one of the ``splits`` of ``info.json``. Default: all episodes.
        dtype (torch.dtype): floating type of the entries.

    Returns:
        TensorDict: flat data ``[N]`` with episodes in the order of their numbers.

    Raises:
        RawFolderError: with the problems of all files and episodes: unreadable files, missing columns, wrong widths,
            values that are not finite, rows or episodes that are missing, actions of the other kind.
        ValueError: if task, kind of actions or split is unknown, or the columns are not those of the task.
        FileNotFoundError: if the folder is no LeRobot data set.
        RuntimeError: if pyarrow is not installed (extra ``lerobot``).

    Examples:
        >>> from torchrl_koap.data.lerobot.reader import read_lerobot
        >>> read_lerobot("/data/d3il_avoiding", "avoiding")  # doctest: +SKIP
    """
    facts = get_task(task)
    lookup(ACTIONS, actions, "kind of actions")
    folder = read_lerobot_folder(root)
    wanted = None if split is None else _episodes_of_split(folder.info, split)
    order = _column_order(facts, folder, root)
    problems, frames_of, steps_of = list(folder.problems), [], []
    for episode in folder.episodes:
        if wanted is not None and episode.number not in wanted:
            continue
        frames = episode.observation[:, order]
        try:
            steps = _checked_actions(facts, frames, episode.action, actions)
        except ValueError as error:
            problems.append(f"{episode.file}: episode {episode.number}: {error}")
            continue
        frames_of.append(torch.from_numpy(frames))
        steps_of.append(torch.from_numpy(steps))
    if problems:
        raise RawFolderError(Path(root), problems)
    if not frames_of:
        raise ValueError(f"{root}: split {split!r} holds none of the episodes")
    _warn(facts, folder.info, torch.cat(frames_of), root)
    return flatten_trajectories(frames_of, steps_of, dtype=dtype)


def _episodes_of_split(info: Mapping, split: str) -> range:
    """LeRobot writes a split as ``"first:end"``, numbers of episodes."""
    span = lookup(info.get("splits") or {}, str(split), "split of this LeRobot data set")
    first, _, end = str(span).partition(":")
    if not first.isdecimal() or not end.isdecimal():
        raise ValueError(f"split {split!r} of info.json must look like '0:50', got {span!r}")
    return range(int(first), int(end))


def _names(folder: LeRobotFolder) -> list[str]:
    """The names that ``info.json`` gives to the observation columns; empty strings where it gives none."""
    features = folder.info.get("features") or {}
    names = []
    for feature, width in folder.widths.items():
        names += given_names(features.get(feature) or {}, width) or [""] * width
    return names


def _column_order(task: Task, folder: LeRobotFolder, root: str | Path) -> list[int]:
    """Where each column of the task's observation lies."""
    names, wanted, width = _names(folder), column_names(task), sum(folder.widths.values())
    if set(names) & set(wanted):
        missing = [name for name in wanted if names.count(name) != 1]
        if missing:
            raise ValueError(f"{root}: observation columns missing for task {task.name!r}: {', '.join(missing)}")
        return [names.index(name) for name in wanted]
    if width != task.observation_dim:
        parts = ", ".join(f"{part} ({columns.stop - columns.start})" for part, columns in task.observation.items())
        others = ", ".join(other.name for other in TASKS.values() if other.observation_dim == width)
        raise ValueError(
            f"{root}: the observation has {width} columns, task {task.name!r} has {task.observation_dim}: {parts}"
            + (f"; tasks with {width} columns: {others}" if others else "")
        )
    if any(names):
        torchrl_logger.warning("%s: names %s are unknown, columns are taken to be %s", root, names, wanted)
    return list(range(width))


def _checked_actions(task: Task, frames: np.ndarray, actions: np.ndarray, kind: str) -> np.ndarray:
    """Changes of the desired position ``[T - 1, act]`` that lead from each row to the next one."""
    if actions.shape[1] != task.action_dim:
        raise ValueError(f"column 'action' has {actions.shape[1]} entries, task {task.name!r} has {task.action_dim}")
    if task.command is None:
        return actions[:-1]  # no command is observed that they could be compared with
    desired, size = frames[:, task.command_columns], len(task.delta_actions)
    changes = np.concatenate([np.diff(desired[:, :size], axis=0), desired[1:, size:]], 1)
    gaps = {
        "delta": np.abs(actions[:-1] - changes).max(),
        "absolute": min(
            np.abs(actions[:-1] - desired[1:]).max(),
            np.abs(actions[:-1, :size] - desired[:-1, :size]).max(),
        ),
    }
    if gaps[kind] <= _SAME_COMMAND:
        return actions[:-1] if kind == "delta" else changes
    other = next(name for name in ACTIONS if name != kind)
    hint = f"; they fit actions={other!r}" if gaps[other] <= _SAME_COMMAND else ""
    what = {"delta": "changes of the desired position", "absolute": "desired positions"}[kind]
    raise ValueError(f"column 'action' does not hold {what}: it is off by up to {gaps[kind]:.3g}{hint}")


def _warn(task: Task, info: Mapping, frames: torch.Tensor, root: str | Path) -> None:
    fps = info.get("fps")
    if isinstance(fps, (int, float)) and abs(fps / task.control_hz - 1) > 0.1:
        torchrl_logger.warning("%s: %g frames per second, task %r has %.4g", root, fps, task.name, task.control_hz)
    yaws = [part for part in task.observation if part.endswith("tan_yaw") and part not in task.hidden]
    if yaws and all(frames[:, task.observation[part]].abs().median() < 0.01 for part in yaws):
        torchrl_logger.warning("%s: tan(yaw) is near zero everywhere; it is probably that of another angle", root)
