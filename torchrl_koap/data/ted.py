# This source code is licensed under the MIT license found in the LICENSE file.
"""A data set on disk: one memory-mapped TED tensordict and a description in JSON beside it.

::

    folder/
      about.json         task, number of trajectories and steps, lengths, statistics, checksums, and the caller's notes
      steps/             the tensordict, one file per entry, in the storage layout of ``torchrl_koap.keys``

The folder is written aside and renamed. When it is read, every file is compared with its checksum.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_leaf_nontensor

from torchrl_koap import keys
from torchrl_koap.data.steps_on_disk import PART, join_on_disk
from torchrl_koap.data.ted_guard import steps_problem
from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.files import read_bytes, replacing_folder, sha256_of
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.registry import find_task, plain_task

FORMAT = 1
_ABOUT = "about.json"
_STEPS = "steps"


class DamagedDataError(ValueError):
    """A data set whose files are missing, changed, or do not belong together."""


def save_ted(
    data: TensorDictBase, folder: str | Path, *, task: str | Task | None = None, notes: Mapping[str, Any] | None = None
) -> Path:
    """Writes flat TED data into a folder; an earlier data set there is replaced in one step.

    Args:
        data (TensorDictBase): flat data ``[N]`` in the storage layout.
        folder (str or Path): folder to create or replace.
        task (str or Task, optional): name of the task; or the task itself, which is kept with the data, so that they
            can be used where nobody registered it.
        notes (mapping, optional): anything JSON can hold that should be kept with the data.

    Returns:
        Path: the folder.

    Raises:
        LayoutError: if the data do not follow the storage layout.
        TypeError: if an entry is no tensor.
        FileExistsError: if the folder holds something other than a data set.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories, load_ted, read_about, save_ted
        >>> data = flatten_trajectories([torch.rand(4, 2), torch.rand(6, 2)], [torch.rand(3, 1), torch.rand(5, 1)])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = save_ted(data, Path(folder) / "demos", notes={"seed": 0})
        ...     load_ted(path).shape, read_about(path)["lengths"], read_about(path)["notes"]
        (torch.Size([8]), [3, 5], {'seed': 0})
    """
    folder = Path(folder)
    known = task if isinstance(task, Task) else find_task(task)
    command = known.command_columns if known else None
    keys.validate(data, command=command)
    entries = data.items(True, True, is_leaf=is_leaf_nontensor)
    strange = [key for key, value in entries if not isinstance(value, torch.Tensor)]
    if strange:  # they would be written as pickles
        raise TypeError(f"only tensors can be saved, {strange} are none")
    if folder.exists() and not (folder.is_dir() and ((folder / _ABOUT).is_file() or not any(folder.iterdir()))):
        raise FileExistsError(f"{folder} exists and holds no data set; it is left as it is")
    about = {
        "format": FORMAT,
        "task": task.name if isinstance(task, Task) else task,
        "definition": task.to_json() if isinstance(task, Task) else None,
        "labelled_steps": int(data.get(keys.HAS_ACTION).sum()),
        "trajectories": len(trajectory_lengths(data)),
        "steps": data.shape[0],
        "lengths": trajectory_lengths(data).tolist(),
        "statistics": _statistics(data),
        "notes": dict(notes or {}),
    }
    with replacing_folder(folder) as aside:
        join_on_disk(data.split(PART), len(data), aside / _STEPS)
        about["sha256"] = _checksums(aside)
        (aside / _ABOUT).write_text(json.dumps(about, indent=1))
    return folder


def read_about(folder: str | Path) -> dict[str, Any]:
    """Reads the description of a data set.

    Args:
        folder (str or Path): folder of the data set.

    Returns:
        dict: ``task``, ``trajectories``, ``steps``, ``lengths``, ``labelled_steps``, ``statistics``, ``notes``,
            ``definition`` (of a task that came along) and ``sha256`` of its files.

    Raises:
        DamagedDataError: if the folder holds no data set, or one written by a newer version.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories, read_about, save_ted
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_ted(flatten_trajectories([torch.rand(5, 4)], [torch.rand(4, 2)]), root + "/ted")
        ...     read_about(folder)["lengths"], read_about(folder)["labelled_steps"]
        ([4], 4)
    """
    path = Path(folder) / _ABOUT
    try:
        about = json.loads(read_bytes(path))
    except FileNotFoundError:
        raise DamagedDataError(f"{folder} holds no data set ({_ABOUT} is missing)") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DamagedDataError(f"{path} cannot be read: {error}") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT or not isinstance(about.get("sha256"), dict):
        raise DamagedDataError(f"{path} is no description of a data set in format {FORMAT}")
    missing = [name for name in ("task", "trajectories", "steps", "lengths", "labelled_steps") if name not in about]
    if missing:
        raise DamagedDataError(f"{path} says nothing of {', '.join(missing)}")
    return about


def read_task(folder: str | Path) -> Task | None:
    """The task that a data set holds, None if it only names one.

    A task of a data set is plain facts. One that names code to import (an environment, rules) is refused: a folder that
    somebody sent must not decide what is run.

    Args:
        folder (str or Path): folder of the data set.

    Returns:
        Task or None: None if the data set only names its task.

    Raises:
        DamagedDataError: if the folder holds no data set, or its task is damaged or names code.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_koap.data import read_task, save_demonstrations
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_demonstrations(root + "/arm", [np.zeros((9, 2))], control_hz=30, action_dim=7)
        ...     print(read_task(folder / "ted").action_dim)
        7
    """
    definition = read_about(folder).get("definition")
    if definition is None:
        return None
    try:
        return plain_task(definition)
    except ValueError as error:
        raise DamagedDataError(f"{Path(folder) / _ABOUT}: {error}") from error


def load_ted(folder: str | Path, *, task: str | None = None, memmap: bool = True) -> TensorDict:
    """Opens a data set written by :func:`save_ted`.

    Args:
        folder (str or Path): the folder.
        task (str, optional): the task the data must belong to.
        memmap (bool): leave the entries on disk (writes into them change the files and are found out by the next
            load), or copy them into memory.

    Returns:
        TensorDict: flat data ``[N]``.

    Raises:
        DamagedDataError: if files are missing, changed, not those that were written, or lead out of the folder.
        ValueError: if the data belong to another task.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories, load_ted, save_ted
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_ted(flatten_trajectories([torch.rand(5, 4)], [torch.rand(4, 2)]), root + "/ted")
        ...     load_ted(folder, memmap=False)["action"].shape
        torch.Size([4, 2])
    """
    folder = Path(folder)
    about = read_about(folder)
    if task is not None and about["task"] != task:
        raise ValueError(f"{folder} holds demonstrations of {about['task']!r}, wanted {task!r}")
    problem = steps_problem(folder / _STEPS)
    if problem is not None:
        raise DamagedDataError(problem)
    found = _checksums(folder)
    for name in sorted(found.keys() | about["sha256"].keys()):
        if found.get(name) != about["sha256"].get(name):
            fault = "was changed"
            if name not in found or name not in about["sha256"]:
                fault = "does not belong there" if name in found else "is missing"
            raise DamagedDataError(f"{folder / name} {fault}")
    try:
        data = TensorDict.load_memmap(folder / _STEPS, allow_pickle=False)
    except Exception as error:  # a forged description passes the checksums and can be wrong in any way
        raise DamagedDataError(f"{folder / _STEPS} cannot be read: {error}") from error
    return data if memmap else data.clone()


def _checksums(folder: Path) -> dict[str, str]:
    return {
        path.relative_to(folder).as_posix(): sha256_of(path)
        for path in sorted((folder / _STEPS).rglob("*"))
        if path.is_file()
    }


def _statistics(data: TensorDictBase) -> dict[str, dict[str, list[float | None]]]:
    """Column statistics of the observations and of the labelled actions, for people who look at the file."""
    statistics = {}
    for key in (keys.OBSERVATION, keys.STATE, keys.ACTION):
        if key not in data.keys():
            continue
        parts = data.get(key).split(PART)
        count, mean = 0, torch.zeros(data.get(key).shape[-1], dtype=torch.double)
        lowest: list[torch.Tensor] = []
        highest: list[torch.Tensor] = []
        for values in map(_finite_rows, parts):
            if len(values):
                count += len(values)
                mean = mean + (values - mean).sum(0) / count
                lowest.append(values.amin(0))
                highest.append(values.amax(0))
        if count:
            squares = torch.stack([(_finite_rows(values) - mean).square().sum(0) for values in parts]).sum(0)
            statistics[key] = {
                "mean": mean.tolist(),
                "std": (squares / count).sqrt().tolist(),
                "min": torch.stack(lowest).amin(0).tolist(),
                "max": torch.stack(highest).amax(0).tolist(),
            }
    return statistics


def _finite_rows(values: torch.Tensor) -> torch.Tensor:
    values = values.double().cpu()
    return values[values.isfinite().all(-1)]
