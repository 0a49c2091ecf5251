# This source code is licensed under the MIT license found in the LICENSE file.
"""Warnings about demonstrations that are right in form and unlikely: said, not refused, since it may be meant."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap import keys
from torchrl_koap.data.trajectories import trajectory_lengths

FARTHEST = 100.0  # m, or rad: no robot on a table gets there


def find_warnings(
    data: TensorDictBase,
    *,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    columns: Sequence[str] = (),
    seen: Sequence[str] = (),
) -> list[str]:
    """Finds trajectories and columns that say nothing or say it twice, and trajectories that cannot have happened.

    Args:
        data (TensorDictBase): flat data ``[N]`` in the storage layout.

    Keyword Args:
        names (sequence of str): what to call each trajectory, such as its file. Default: their numbers.
        units (sequence of str): unit of every observation column; positions in m and angles in rad are looked at.
            Default: no column is.
        columns (sequence of str): what to call the observation columns. Default: their numbers.
        seen (sequence of str): what to call the columns of ``state``, those that are seen. Default: none is looked at.

    Returns:
        list of str: a sentence each: a trajectory that repeats another one, one without any movement, one whose labels
        are all zero, one that reaches a place beyond 100 m or rad; a seen column that never changes, or that is the
        same as another one in every step.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories
        >>> from torchrl_koap.data.quality import find_warnings
        >>> path, still = torch.arange(6.0).reshape(3, 2), torch.zeros(2, 1)
        >>> find_warnings(flatten_trajectories([path, path], [still + 1, still + 1]), names=["a.pkl", "b.pkl"])
        ['b.pkl repeats a.pkl: every step is the same']
        >>> find_warnings(flatten_trajectories([1e6 * path, path], [still + 1, still]), units=["m", "m"])
        ['trajectory 0: column 0 reaches 2e+06 m', 'trajectory 1: all 2 labelled actions are zero']
    """
    warnings: list[str] = []
    first: dict[bytes, str] = {}
    lengths = trajectory_lengths(data).tolist()
    looked_at = [column for column, unit in enumerate(units) if unit in ("m", "rad")]
    entries = [data.get(key) for key in (keys.OBSERVATION, keys.ACTION, keys.HAS_ACTION, keys.NEXT_OBSERVATION)]
    for index, end in enumerate(itertools.accumulate(lengths)):
        name = names[index] if index < len(names) else f"trajectory {index}"
        observed, actions, has_action, last = (entry[end - lengths[index] : end] for entry in entries)
        same = first.setdefault(_digest(observed, actions, last[-1:]), name)
        if same is not name:
            warnings.append(f"{name} repeats {same}: every step is the same")
            continue
        labelled = actions[has_action.squeeze(-1)]
        if len(labelled) and not labelled.any():
            warnings.append(f"{name}: all {len(labelled)} labelled actions are zero")
        if bool((observed == observed[:1]).all()) and bool((last == observed[:1]).all()):
            warnings.append(f"{name}: nothing moves in its {len(observed)} steps")
        for column in looked_at:
            farthest = observed[:, column].abs().max()
            if farthest > FARTHEST:
                called = columns[column] if column < len(columns) else f"column {column}"
                warnings.append(f"{name}: {called} reaches {farthest:.3g} {units[column]}")
                break
    return warnings + _column_warnings(data.get(keys.STATE), seen) if seen else warnings


def _column_warnings(state: Tensor, names: Sequence[str]) -> list[str]:
    found: list[str] = []
    first: dict[bytes, str] = {}
    for name, values in zip(names, state.unbind(-1), strict=True):
        if bool((values == values[:1]).all()):
            found.append(f"column {name!r} is {values[0]:g} in all {len(values)} steps: it says nothing")
            continue
        same = first.setdefault(_digest(values), name)
        if same is not name:
            found.append(f"columns {same!r} and {name!r} are the same in every step")
    return found


def constant_actions(actions: np.ndarray, names: Sequence[str]) -> list[str]:
    """Names actions that are the same in all labels, of which nothing can be learnt.

    Args:
        actions (np.ndarray): actions ``[N, act]``, NaN where there is no label.
        names (sequence of str): names of the columns.

    Returns:
        list of str: a sentence for each.
    """
    steps = actions[np.isfinite(actions).all(-1)]
    if len(steps) < 2:
        return []
    return [
        f"action {names[column]!r} is {steps[0, column]:g} in all {len(steps)} labels: nothing can be learnt of it;"
        " leave it out"
        for column in np.flatnonzero(np.ptp(steps, axis=0) == 0)
    ]


def _digest(*values: Tensor) -> bytes:
    digest = hashlib.sha256()
    for value in values:
        digest.update(value.contiguous().reshape(-1).view(torch.uint8).cpu().numpy())
    return digest.digest()
