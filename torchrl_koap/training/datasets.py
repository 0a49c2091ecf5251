# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations of a task as one tensordict, wherever they are from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import D3ILExperienceReplay, load_ted, read_about, read_task, select_state
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
        DamagedDataError: if the data set's task is damaged or names code.

    Examples:
        >>> from torchrl_koap.training.datasets import find_task_of
        >>> find_task_of("scripted").name, find_task_of("scripted", "sorting").name
        ('avoiding', 'sorting')
    """
    folder = Path(dataset) / "ted"
    if dataset != "scripted" and not Path(dataset).is_dir():
        raise FileNotFoundError(f"dataset {dataset!r} is neither 'scripted' nor a folder of {Path.cwd()}")
    if dataset == "scripted" or not folder.is_dir():
        return get_task(DEFAULT_TASK if name is None else name)
    own = read_task(folder)
    if own is None:
        return get_task(name or read_about(folder)["task"] or DEFAULT_TASK)
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
        dataset (str): ``"scripted"``, or a folder: of D3IL's raw pickles, a LeRobot data set, or written by
            ``koap demos``.
        task (Task): the task.
        episodes (int, optional): number of scripted demonstrations to record. Default: that of the task.
        seed (int): seed of the scripted demonstrations.
        progress (callable, optional): called with the number of demonstrations that were recorded, or read from raw
            files, and that of all.

    Returns:
        TensorDictBase: flat data ``[N]`` with ``state`` and every recorded label.

    Raises:
        FileNotFoundError: if there is no such folder, or it holds no demonstrations.

    Examples:
        >>> import tempfile
        >>> import numpy as np
        >>> from torchrl_koap.data import read_task, save_demonstrations
        >>> from torchrl_koap.training import load_demonstrations
        >>> with tempfile.TemporaryDirectory() as root:
        ...     folder = save_demonstrations(root + "/arm", [np.random.rand(9, 3)], control_hz=30, action_dim=2)
        ...     load_demonstrations(str(folder), read_task(folder / "ted"))["state"].shape
        torch.Size([8, 3])
    """
    if dataset == "scripted":
        from torchrl_koap.envs.experts.demonstrations import record_demonstrations  # needs a simulator

        data, _ = record_demonstrations(
            task.name, task.defaults.demonstrations if episodes is None else episodes, seed, progress=progress
        )
    elif not Path(dataset).is_dir():
        raise FileNotFoundError(f"dataset {dataset!r} is neither 'scripted' nor a folder")
    elif (Path(dataset) / "ted").is_dir():
        data = load_ted(Path(dataset) / "ted", task=task.source, memmap=False)
    else:
        data = D3ILExperienceReplay(task.name, dataset, progress=progress).data.clone()
    if task.noise:
        data = with_noise(data, task.observation[task.position], task.noise)
    return select_state(data, task.state_of)


def with_noise(data: TensorDictBase, columns: slice, sigma: float, *, seed: int = 0) -> TensorDictBase:
    """Demonstrations as a noisy sensor would have recorded them: actions are untouched.

    A frame has the same noise as the next observation of a step and as the observation of the step that follows it.

    Args:
        data (TensorDictBase): flat data ``[N]``; not changed.
        columns (slice): observation columns that are disturbed.
        sigma (float): standard deviation of the noise, in the units of the columns.

    Keyword Args:
        seed (int): seed of the noise: every reader of the same data meets the same. Defaults to ``0``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories
        >>> from torchrl_koap.training.datasets import with_noise
        >>> data = flatten_trajectories([torch.zeros(4, 3)] * 2, [torch.zeros(3, 1)] * 2)
        >>> noisy = with_noise(data, slice(1, 3), 0.002)
        >>> bool((noisy["next", "observation"][0] == noisy["observation"][1]).all())
        True
        >>> noisy["observation"].count_nonzero(dim=0).tolist()
        [0, 6, 6]
    """
    generator = torch.Generator().manual_seed(seed)
    now, following = data["observation"].clone(), data["next", "observation"].clone()
    last = torch.ones(len(now), dtype=torch.bool)
    last[:-1] = data["episode"][1:] != data["episode"][:-1]
    shape = now[:, columns].shape
    noise, ends = (sigma * torch.randn(shape, generator=generator, dtype=now.dtype) for _ in range(2))
    after = torch.where(last[:, None], ends, noise.roll(-1, 0))
    now[:, columns] += noise
    following[:, columns] += after
    return data.copy().set("observation", now).set("next", data["next"].copy().set("observation", following))
