# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations of a task as one tensordict, wherever they are from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tensordict import TensorDictBase

from torchrl_koap.data import open_dataset, read_about, select_state
from torchrl_koap.data.sources import with_noise
from torchrl_koap.data.ted import stored_folder, stored_task
from torchrl_koap.tasks import Task, adopt_task, get_task

DEFAULT_TASK = "avoiding"


def find_task_of(dataset: str, name: str | None = None) -> Task:
    """The task of a data set.

    Args:
        dataset (str): as for :func:`load_demonstrations`.
        name (str, optional): name of a registered task, or of the one that the data set holds. Default: the task that
            the data set holds or names, else ``"avoiding"``.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if the name is unknown, or the data set holds the definition of another task.
        DataError: if the data set's task is damaged or names code.

    Examples:
        >>> from torchrl_koap.training.datasets import find_task_of
        >>> find_task_of("scripted").name, find_task_of("scripted", "sorting").name
        ('avoiding', 'sorting')
    """
    if dataset == "scripted":
        return get_task(DEFAULT_TASK if name is None else name)
    if not Path(dataset).is_dir():
        raise FileNotFoundError(f"dataset {dataset!r} is neither 'scripted' nor a folder of {Path.cwd()}")
    folder = stored_folder(dataset)
    if folder is None:
        return get_task(DEFAULT_TASK if name is None else name)
    about = read_about(folder)
    if about.get("definition") is None:
        return get_task(name or about["task"])
    own = stored_task(folder)
    if name not in (None, own.name):
        raise ValueError(f"dataset {dataset!r} holds its own task {own.name!r}; --task {name} does not fit it")
    return adopt_task(own)


def load_demonstrations(
    dataset: str,
    task: Task,
    *,
    episodes: int | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> TensorDictBase:
    """Demonstrations with all labels that there are, flat, with the columns that a policy may see as ``state``.

    Args:
        dataset (str): ``"scripted"``, or a folder for :func:`~torchrl_koap.data.open_dataset`.
        task (Task): the task.
        episodes (int, optional): number of scripted demonstrations to record. Default: that of the task.
        seed (int): seed of the scripted demonstrations.
        progress (callable, optional): called with the number of demonstrations that were recorded, or read from raw
            files, and that of all.

    Returns:
        TensorDictBase: flat data ``[N]`` with ``state`` and every recorded label.

    Raises:
        FileNotFoundError: if there is no such folder, or it holds no demonstrations.
    """
    if dataset != "scripted":
        return open_dataset(dataset, task=task, progress=progress)[0]
    from torchrl_koap.envs.experts.demonstrations import record_demonstrations  # needs a simulator

    data, _ = record_demonstrations(
        task.name, task.defaults.demonstrations if episodes is None else episodes, seed, progress=progress
    )
    if task.noise:
        data = with_noise(data, task.observation[task.position], task.noise)
    return select_state(data, task.state_of)
