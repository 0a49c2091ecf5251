# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations of a task, and which of their trajectories and labels are learnt from."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import LabelBudget, open_dataset, read_about, trajectory_lengths
from torchrl_koap.data.sources import find_stored
from torchrl_koap.data.ted import stored_task
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import read_config
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import Task, get_task

DEFAULT_TASK = "avoiding"  # of raw pickles
# what is derived from these may differ from version to version
_RECORDED = ("observation", "action", "has_action", "episode", "step_count", ("next", "observation"), ("next", "done"))


def find_task_of(dataset: str | None, name: str | None = None) -> Task:
    """Finds the task of a data set: the one named, else the one that it holds or names; of raw pickles ``"avoiding"``.

    Raises:
        FileNotFoundError: if there is no such folder.
        ValueError: if none is named, the name is unknown, or the data set holds the definition of another task.
        DataError: if the data set's task is damaged or names code, or the data are to be converted first.
    """
    if dataset is None:
        what = name or DEFAULT_TASK
        raise ValueError(
            f"no demonstrations to learn from: record some with `koap demos --task {what} --out DEMOS`, then"
            f" `koap train --task {what} --dataset DEMOS --out RUN`"
        )
    folder = find_stored(dataset)
    if folder is None:
        return get_task(DEFAULT_TASK if name is None else name)
    about = read_about(folder)
    if about.get("definition") is None:
        return get_task(name or about["task"])
    own = stored_task(folder)
    if name not in (None, own.name):
        raise ValueError(f"dataset {dataset!r} holds its own task {own.name!r}; --task {name} does not fit it")
    return own


def load_demonstrations(
    dataset: str, task: Task, *, progress: Callable[[int, int], None] | None = None
) -> TensorDictBase:
    """Reads demonstrations whose task is known.

    Args:
        dataset (str): folder, as for :func:`~torchrl_koap.data.open_dataset`.
        task (Task): the task.

    Keyword Args:
        progress (callable, optional): called with the number of files read and of all.

    Returns:
        TensorDictBase: flat data ``[N]`` with ``state``.

    Examples:
        >>> from torchrl_koap.training.datasets import load_demonstrations
        >>> load_demonstrations("runs/demos", get_task("avoiding"))  # doctest: +SKIP
    """
    return open_dataset(dataset, task=task, progress=progress)[0]


def label_budget(config: TrainConfig) -> LabelBudget:
    """Makes the label budget that a resolved configuration asks for."""
    labels = config.labels
    chosen: dict[str, Any] = {"fraction": labels.fraction, "count": labels.count, "episodes": labels.episodes or None}
    return LabelBudget(**chosen, unit=cast(Any, labels.unit), seed=config.run.seed)


def fingerprint(data: TensorDictBase) -> dict[str, Any]:
    """What tells flat data ``[N]`` from others: their size, and a checksum of what was recorded.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.training.datasets import fingerprint
        >>> one, other = (TensorDict({"action": torch.tensor([[0.0], [last]])}, [2]) for last in (1.0, 2.0))
        >>> fingerprint(one) == fingerprint(one.clone()), fingerprint(one) == fingerprint(other)
        (True, False)
    """
    digest = hashlib.sha256()
    present = set(data.keys(True, True))
    for name in [name for name in _RECORDED if name in present]:
        value = data.get(name).detach().cpu().contiguous()
        digest.update(f"{name} {value.dtype} {list(value.shape)}".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy())
    return {"steps": len(data), "sha256": digest.hexdigest()}


def choose_held_out(data: TensorDictBase, fraction: float | None, *, seed: int = 0) -> list[int]:
    """Numbers of the trajectories to hold out from the planner: those without a label first.

    Trajectories with labels are taken only where the others do not suffice. They lose no label: the planner does not
    see them, the controller does. At least one trajectory is held out, of ten or more at least two, and at least one is
    left; of a single trajectory none can be.

    The fraction is a share of all trajectories of flat data ``[N]``, in ``[0, 1)``; None is 0.

    Raises:
        ValueError: if the share is out of range.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import LabelBudget, flatten_trajectories
        >>> from torchrl_koap.training.datasets import choose_held_out
        >>> data = flatten_trajectories([torch.zeros(5, 2)] * 10, [torch.zeros(4, 1)] * 10)
        >>> labelled, _ = LabelBudget(episodes=range(2, 10)).apply(data)
        >>> choose_held_out(labelled, 0.1)
        [0, 1]
    """
    if not fraction:
        return []
    if not 0 < fraction < 1:
        raise ValueError(f"planner.held_out must be in [0, 1), got {fraction}")
    lengths = trajectory_lengths(data)
    total = len(lengths)
    number = min(max(math.floor(fraction * total + 0.5), 1 if total < 10 else 2), total - 1)
    episodes = data["episode"][torch.cumsum(lengths, 0) - lengths].cpu()
    labelled = torch.stack([part.any() for part in data["has_action"].split(lengths.tolist())]).cpu()
    order = torch.randperm(total, generator=torch.Generator().manual_seed(seed))
    order = torch.cat([order[~labelled[order]], order[labelled[order]]])
    return sorted(episodes[order[:number]].tolist())


def held_out_by(source: Path, dataset: str) -> list[int]:
    """Reads which trajectories the planner of a run has never seen; none of another data set than its own."""
    run = RunDirectory(source)
    same = os.path.abspath(str(read_config(run).dataset)) == os.path.abspath(dataset)
    return list(run.read_json("config.json").get("held_out_episodes") or ()) if same else []


def without_held_out(data: TensorDictBase, episodes: Sequence[int], *, keep_labelled: bool = False) -> TensorDictBase:
    """Leaves held-out trajectories out of flat data ``[N]``; those with a label stay for a controller, if asked for.

    Raises:
        ValueError: if nothing is left.
    """
    if not len(episodes):
        return data
    episode = data["episode"]
    held_out = torch.isin(episode, torch.as_tensor(list(episodes), device=episode.device))
    if keep_labelled:
        held_out &= ~torch.isin(episode, episode[data["has_action"].squeeze(-1)].unique())
    if held_out.all():
        raise ValueError(
            f"all {len(episode.unique())} trajectories that are used are held out: nothing is left to"
            " train on; lower planner.held_out or raise labels.trajectories"
        )
    return data[~held_out]
