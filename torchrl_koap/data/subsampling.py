# This source code is licensed under the MIT license found in the LICENSE file.
"""A share of the trajectories: what a smaller data set with the same labels would be."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.data.trajectories import trajectory_lengths


def subsample_trajectories(data: TensorDictBase, fraction: float, *, seed: int = 0) -> TensorDictBase:
    """Drops whole trajectories without a label until a share of all trajectories is left.

    Trajectories with a label always stay. Of one seed, a smaller share is part of every larger one.

    Args:
        data (TensorDictBase): flat data ``[N]`` after the label budget was applied; not changed.
        fraction (float): share of the trajectories to keep, in ``(0, 1]``.

    Keyword Args:
        seed (int): seed of the choice.

    Returns:
        TensorDictBase: flat data in the order of ``data``; ``data`` itself if nothing is dropped.

    Raises:
        ValueError: if the share is out of range, or smaller than that of the trajectories with labels.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import LabelBudget, flatten_trajectories, subsample_trajectories
        >>> data = flatten_trajectories([torch.zeros(5, 2)] * 10, [torch.zeros(4, 1)] * 10)
        >>> data, _ = LabelBudget(2).apply(data)
        >>> kept = subsample_trajectories(data, 0.5)
        >>> len(kept["episode"].unique()), int(kept["has_action"].sum())
        (5, 8)
    """
    if not 0 < fraction <= 1:
        raise ValueError(f"observation fraction must be in (0, 1], got {fraction}")
    lengths = trajectory_lengths(data)
    number = math.floor(fraction * len(lengths) + 0.5)
    labelled = torch.stack([part.any() for part in data.get(keys.HAS_ACTION).split(lengths.tolist())]).cpu()
    if number < max(int(labelled.sum()), 1):
        raise ValueError(
            f"an observation fraction of {fraction} keeps {number} of {len(lengths)} trajectories,"
            f" but {int(labelled.sum())} have labels"
        )
    if number == len(lengths):
        return data
    order = torch.randperm(len(lengths), generator=torch.Generator().manual_seed(seed))
    order = torch.cat([order[labelled[order]], order[~labelled[order]]])
    kept = torch.zeros(len(lengths), dtype=torch.bool)
    kept[order[:number]] = True
    return data[kept.to(lengths.device).repeat_interleave(lengths)]
