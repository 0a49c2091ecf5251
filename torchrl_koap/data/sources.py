# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads a folder of demonstrations: the data and their task, for every command."""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_koap.data.d3il.conversion import CONVERTERS, read_raw
from torchrl_koap.data.formats import FORMATS, find_format
from torchrl_koap.data.ted import read_about, read_steps, stored_folder, stored_task
from torchrl_koap.data.trajectories import flatten_trajectories, select_state, trajectory_lengths
from torchrl_koap.files import DataError
from torchrl_koap.lookup import nearest
from torchrl_koap.tasks import TASKS, Task, get_task

DEFAULT_TASK = "avoiding"  # task of D3IL's pickles unless another one is named


def open_dataset(
    folder: str | Path, *, task: Task | None = None, progress: Callable[[int, int], None] | None = None
) -> tuple[TensorDictBase, Task]:
    """Reads demonstrations with all their labels, and adds the state and the sensor noise of their task.

    Args:
        folder (str or Path): folder written by ``koap demos``, ``koap convert``, ``koap embed`` or
            :func:`~torchrl_koap.data.save_demonstrations`, or a folder of D3IL's raw pickles.

    Keyword Args:
        task (Task, optional): the data's task, or one that uses the same demonstrations, as ``po_sorting`` uses those
            of ``sorting``. Default: the data's own task; ``avoiding`` for raw pickles.
        progress (callable, optional): called with the number of raw files read so far, and of all raw files.

    Returns:
        tuple: flat data ``[N]`` in the storage layout with ``state``, the columns that a policy may see, with the
        task's noise; and the task.

    Raises:
        FileNotFoundError: if there is no such folder, or it holds no demonstrations.
        DataError: if the data are damaged, of another task, or name a task that is not registered.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_koap.data import open_dataset, save_demonstrations
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_demonstrations(root + "/arm", [np.random.rand(9, 3)], control_hz=30, action_dim=2)
        ...     data, task = open_dataset(folder)
        >>> data["state"].shape, task.name
        (torch.Size([8, 3]), 'arm')
    """
    folder = Path(folder).expanduser()
    task, stored = find_task_of(folder) if task is None else task, _find_stored(folder)
    if stored is not None:
        name = read_about(stored)["task"]
        if name not in (task.name, task.source):
            raise DataError(stored, f"it holds demonstrations of {name!r}, wanted {task.source!r}")
        data = read_steps(stored)
    elif task.source not in CONVERTERS:
        raise DataError(folder, f"it holds no data set, and D3IL has no task {task.name!r}: `koap convert` it")
    else:
        data = flatten_trajectories(*read_raw(CONVERTERS[task.source], folder, progress=progress))
    if data["observation"].shape[-1] != task.observation_dim or data["action"].shape[-1] != task.action_dim:
        raise DataError(
            folder,
            f"it has {data['observation'].shape[-1]} observation and {data['action'].shape[-1]} action columns, task"
            f" {task.name!r} has {task.observation_dim} and {task.action_dim}",
        )
    if task.noise:
        data = with_noise(data, task.observation[task.position], task.noise)
    return select_state(data, task.state_of), task


def find_task_of(dataset: str | Path | None, name: str | None = None) -> Task:
    """Finds the task of a data set: ``name``, else the one it holds or names; for raw pickles ``"avoiding"``.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if ``dataset`` is None, the name is unknown, or the data set holds the definition of another task.
        DataError: if the data set's task is damaged or names code, or the data must be converted first.
    """
    if dataset is None:
        what = name or DEFAULT_TASK
        raise ValueError(
            f"no demonstrations to learn from: record some with `koap demos --task {what} --out DEMOS`, then"
            f" `koap train --task {what} --dataset DEMOS --out RUN`"
        )
    folder = _find_stored(dataset)
    if folder is None or name is not None and read_about(folder).get("definition") is None:
        return get_task(name or DEFAULT_TASK)
    own = stored_task(folder)
    if name not in (None, own.name):
        raise ValueError(f"dataset {str(dataset)!r} holds its own task {own.name!r}, not {name!r}")
    if name is not None and TASKS.get(name, own) != own:
        said = f"dataset {str(dataset)!r} holds its own task {name!r}, which differs from the registered one"
        warnings.warn(f"{said}: the data set's is used; save the data again to use the other", stacklevel=2)
    return own


def check_new(folder: str | Path) -> None:
    """Raises a FileExistsError if a folder already holds a data set, recordings or a run."""
    folder = Path(folder).expanduser()
    if (folder / "config.json").exists() or find_format(folder) is not None:
        raise FileExistsError(f"{folder} holds a data set, recordings or a run already; choose another --out")


def _find_stored(source: str | Path) -> Path | None:
    """Returns the folder of this library's data set; None if ``source`` may hold D3IL's raw pickles."""
    form = find_format(source)
    if form == "ted":
        return stored_folder(source)
    if form is not None:
        out = shlex.quote(f"{Path(source).stem}_data")
        raise DataError(
            source,
            f"it is {FORMATS[form].what}, without the roles of its columns:"
            f" `koap convert {shlex.quote(str(source))} --out {out}`, then `--dataset {out}`",
        )
    if not Path(source).is_dir():
        path = Path(source)
        near = nearest([other.name for other in path.parent.glob("*") if other.is_dir()], path.name)
        hint = "" if near is None else f"did you mean {str(path.with_name(near))!r}? "
        raise FileNotFoundError(
            f"dataset {str(source)!r} is no folder in {Path.cwd()}; {hint}`koap convert DATA --out DIR` makes one from"
            " your data, `koap demos --out DIR` records one"
        )
    return None


def with_noise(data: TensorDictBase, columns: slice, sigma: float) -> TensorDictBase:
    """Adds sensor noise with standard deviation ``sigma`` to some observation columns of flat data ``[N]``.

    A frame has the same noise as next observation of one step and as observation of the following step. Actions do not
    change.
    """
    generator = torch.Generator().manual_seed(0)
    now, following = data["observation"].clone(), data["next", "observation"].clone()
    shape, last = now[:, columns].shape, trajectory_lengths(data).cumsum(0) - 1
    noise, ends = (sigma * torch.randn(shape, generator=generator, dtype=now.dtype) for _ in range(2))
    after = noise.roll(-1, 0)
    after[last] = ends[last]
    now[:, columns] += noise
    following[:, columns] += after
    return data.copy().set("observation", now).set("next", data["next"].copy().set("observation", following))
