# This source code is licensed under the MIT license found in the LICENSE file.
"""Validation trajectories: those that a planner never sees, so that its plans can be judged without an environment."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import trajectory_lengths
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.tasks import Task

WITHOUT_ENVIRONMENT = 0.1  # share that is held out by default where no rollout can tell what a planner is worth


def default_fraction(task: Task) -> float | None:
    """Share of the trajectories that is held out unless asked otherwise; None: none.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.training.validation import default_fraction
        >>> default_fraction(get_task("avoiding")) is None
        True
    """
    return WITHOUT_ENVIRONMENT if task.env is None else None


def choose_validation(data: TensorDictBase, fraction: float | None, *, seed: int = 0) -> list[int]:
    """Numbers of the trajectories to hold out from the planner: those without a label first.

    Trajectories with labels are taken only where the others do not suffice. They lose no label: the planner does not
    see them, the controller does. At least one trajectory is held out, and at least one is left; of a single trajectory
    none can be.

    Args:
        data (TensorDictBase): flat data ``[N]`` after the label budget was applied.
        fraction (float, optional): share of all trajectories in ``[0, 1)``; None is 0.

    Keyword Args:
        seed (int): seed of the choice.

    Raises:
        ValueError: if the share is out of range.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import LabelBudget, flatten_trajectories
        >>> from torchrl_koap.training.validation import choose_validation
        >>> data = flatten_trajectories([torch.zeros(5, 2)] * 10, [torch.zeros(4, 1)] * 10)
        >>> labelled, _ = LabelBudget(episodes=[1, 2, 3, 4, 5, 6, 7, 8, 9]).apply(data)
        >>> choose_validation(labelled, 0.1)
        [0]
    """
    if not fraction:
        return []
    if not 0 < fraction < 1:
        raise ValueError(f"validation_fraction must be in [0, 1), got {fraction}")
    lengths = trajectory_lengths(data)
    total = len(lengths)
    number = min(max(math.floor(fraction * total + 0.5), 1), total - 1)
    episodes = data["episode"][torch.cumsum(lengths, 0) - lengths].cpu()
    labelled = torch.stack([part.any() for part in data["has_action"].split(lengths.tolist())]).cpu()
    order = torch.randperm(total, generator=torch.Generator().manual_seed(seed))
    order = torch.cat([order[~labelled[order]], order[labelled[order]]])
    return sorted(episodes[order[:number]].tolist())


def validation_of(planner_from: Path, dataset: str) -> list[int]:
    """The validation trajectories of a planner that is taken over: it has seen all others.

    Args:
        planner_from (Path): its run directory.
        dataset (str): the data set it is to be judged on; on another one than its own nothing is known to be unseen.
    """
    config = RunDirectory(planner_from).read_json("config.json")
    same = os.path.abspath(str(config.get("dataset"))) == os.path.abspath(dataset)
    return list(config.get("validation_episodes") or ()) if same else []


def without_validation(data: TensorDictBase, episodes: Sequence[int], *, keep_labelled: bool = False) -> TensorDictBase:
    """The data that may be learnt from.

    Args:
        data (TensorDictBase): flat data ``[N]`` after the label budget was applied.
        episodes (sequence of int): validation trajectories.

    Keyword Args:
        keep_labelled (bool): keep those of them that have a label, as a controller does.

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
            f"all {len(episode.unique())} trajectories that are used are held out for validation: nothing is left to"
            " train on; lower validation_fraction or raise observation_fraction"
        )
    return data[~held_out]
