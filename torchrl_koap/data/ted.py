# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads and writes data sets on disk: TED data as safetensors, with a description in JSON.

::

    folder/
      about.json           task, number of trajectories and steps, lengths, checksum, and the caller's notes
      steps.safetensors    the entries in the storage layout of ``torchrl_koap.keys``, nested ones as ``next/done``

The folder is written under a temporary name, then renamed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from tensordict import TensorDict, TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.files import DataError, read_json, replacing_file, replacing_folder, sha256_of
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.registry import task_from

FORMAT = 2
CAMERAS = "cameras"  # folder of the projections that embed camera frames, beside a data set and in a run
_ABOUT, _STEPS = "about.json", "steps.safetensors"


def save_ted(data: TensorDictBase, folder: str | Path, task: Task, notes: Mapping[str, Any] | None = None) -> Path:
    """Writes flat TED data into a folder; replaces an earlier data set once the new one is complete.

    Args:
        data (TensorDictBase): flat data ``[N]`` in the storage layout.
        folder (str or Path): folder to create or replace.
        task (Task): task of the data. Its definition is stored if it references no code, otherwise only its name.
        notes (mapping, optional): further JSON values to store with the data.

    Returns:
        Path: the folder.

    Raises:
        DataError: if the data do not follow the storage layout.
        ValueError: if an entry is not a tensor.
        FileExistsError: if the folder holds something other than a data set.

    Examples:
        >>> import tempfile
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories, load_ted, save_ted
        >>> from torchrl_koap.data.ted import read_about
        >>> from torchrl_koap.tasks import get_task
        >>> data = flatten_trajectories([torch.rand(4, 4), torch.rand(6, 4)], [torch.rand(3, 2), torch.rand(5, 2)])
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_ted(data, root + "/ted", get_task("avoiding"), notes={"seed": 0})
        ...     load_ted(folder)[0].shape, load_ted(folder)[1].name, read_about(folder)["lengths"]
        (torch.Size([8]), 'avoiding', [3, 5])
    """
    folder = Path(folder)
    keys.validate(data, command=task.command_columns)
    entries = dict(data.flatten_keys("/").items())
    if folder.exists() and not (folder.is_dir() and ((folder / _ABOUT).is_file() or not any(folder.iterdir()))):
        raise FileExistsError(f"{folder} exists and holds no data set; it was not changed")
    lengths = trajectory_lengths(data).tolist()
    about = {
        "format": FORMAT,
        "task": task.name,
        "definition": task.definition(),
        "trajectories": len(lengths),
        "steps": len(data),
        "lengths": lengths,
        "labelled_steps": int(data.get(keys.HAS_ACTION).sum()),
        "notes": dict(notes or {}),
    }
    with replacing_folder(folder) as aside:
        with replacing_file(aside / _STEPS) as file:
            save_file({name: value.detach().cpu().clone().contiguous() for name, value in entries.items()}, file)
        about |= {"bytes": (aside / _STEPS).stat().st_size, "sha256": sha256_of(aside / _STEPS)}
        (aside / _ABOUT).write_text(json.dumps(about, indent=1))
    return folder


def stored_folder(folder: str | Path) -> Path | None:
    """Returns the folder of this library's data set: ``folder`` itself or ``ted`` in it; None if neither."""
    folder = Path(folder)
    if (folder / "ted").is_dir():
        return folder / "ted"
    return folder if (folder / _ABOUT).is_file() else None


def read_about(folder: str | Path) -> dict[str, Any]:
    """Reads the description of a data set.

    It has ``task``, ``definition`` (None if only the name is stored), ``trajectories``, ``steps``, ``lengths``,
    ``labelled_steps``, ``notes``, and size and checksum of the steps.

    Raises:
        DataError: if the folder holds no data set, or one in another format.
    """
    path = Path(folder) / _ABOUT
    try:
        about = read_json(path)
    except FileNotFoundError:
        raise DataError(folder, f"it holds no data set ({_ABOUT} is missing)") from None
    if about.get("format") != FORMAT:
        raise DataError(path, f"it is no description of a data set in format {FORMAT}")
    kinds: dict[str, type] = dict.fromkeys(("trajectories", "steps", "labelled_steps", "bytes"), int)
    kinds |= {"task": str, "sha256": str, "lengths": list, "notes": dict}
    wrong = [name for name, kind in kinds.items() if not isinstance(about.get(name), kind)]
    if wrong:
        raise DataError(path, f"missing or invalid: {', '.join(wrong)}")
    return about


def source_names(folder: str | Path) -> list[str]:
    """Returns the source of each trajectory of a data set, such as its file; an empty list if none is stored.

    Raises a DataError if the notes of the data set hold anything else.
    """
    stored = stored_folder(folder)
    names = [] if stored is None else read_about(stored)["notes"].get("sources", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise DataError(stored / _ABOUT, "notes.sources must be a list of names")
    return names


def load_ted(folder: str | Path) -> tuple[TensorDict, Task]:
    """Reads a data set that :func:`save_ted` wrote.

    A task that names code to import is refused: a received folder must not choose the code that runs.

    Returns:
        tuple: flat data ``[N]``, and their task.

    Raises:
        DataError: if files are missing, changed or damaged, or the task names code or is not registered.

    Examples:
        >>> from torchrl_koap.data import load_ted
        >>> data, task = load_ted("demos/ted")  # doctest: +SKIP
    """
    task = stored_task(folder)
    return read_steps(folder), task


def stored_task(folder: str | Path) -> Task:
    """Reads the task of a data set: the stored definition, or the registered task of that name.

    Raises:
        DataError: if the folder holds no data set, or its task is damaged, names code or is not registered.
    """
    about = read_about(folder)
    try:
        return task_from(about["task"], about.get("definition"))
    except ValueError as error:
        raise DataError(Path(folder) / _ABOUT, str(error)) from error


def read_steps(folder: str | Path) -> TensorDict:
    """Reads the data of a data set ``[N]`` without its task; raises a DataError if files are missing or damaged."""
    about, path = read_about(folder), Path(folder) / _STEPS
    try:
        if path.stat().st_size != about["bytes"] or sha256_of(path) != about["sha256"]:
            raise DataError(path, "it was changed: its size or checksum differs from about.json")
        return TensorDict(load_file(path), [about["steps"]]).unflatten_keys("/")
    except DataError:
        raise
    except FileNotFoundError:
        raise DataError(path, "it is missing") from None
    except (OSError, SafetensorError, RuntimeError, ValueError, KeyError, TypeError) as error:
        raise DataError(path, f"its entries do not have {about['steps']} steps: {error}") from error
