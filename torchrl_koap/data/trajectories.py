# This source code is licensed under the MIT license found in the LICENSE file.
"""From separate trajectories to the flat storage layout, and the columns a policy may see."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_koap import keys


def flatten_trajectories(
    observations: Sequence[torch.Tensor], actions: Sequence[torch.Tensor], *, dtype: torch.dtype = torch.float32
) -> TensorDict:
    """Lays recorded trajectories one after the other in the storage layout.

    ``T`` frames make ``T - 1`` steps: step ``t`` goes from frame ``t`` to frame ``t + 1``. The last step of every
    trajectory is marked as terminated, and all actions as labelled.

    Args:
        observations (sequence of Tensor): for each trajectory its frames ``[T_i, obs]``.
        actions (sequence of Tensor): for each trajectory its actions ``[T_i - 1, act]``.
        dtype (torch.dtype): floating type of the entries.

    Returns:
        TensorDict: flat data ``[sum(T_i - 1)]``.

    Raises:
        ValueError: if the numbers of trajectories, frames, actions or columns do not fit each other.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories
        >>> data = flatten_trajectories([torch.arange(8.0).reshape(4, 2)], [torch.ones(3, 1)])
        >>> data["observation"][1], data["next", "observation"][1], data["next", "done"].squeeze(-1)
        (tensor([2., 3.]), tensor([4., 5.]), tensor([False, False,  True]))
    """
    observations = [torch.as_tensor(frames) for frames in observations]
    actions = [torch.as_tensor(steps) for steps in actions]
    if not observations or len(observations) != len(actions):
        raise ValueError(f"{len(observations)} trajectories of observations, {len(actions)} of actions")
    for index, (frames, steps) in enumerate(zip(observations, actions, strict=True)):
        if frames.ndim != 2 or steps.ndim != 2 or len(frames) < 2 or len(steps) != len(frames) - 1:
            raise ValueError(
                f"trajectory {index}: wanted observations [T, obs] and actions [T - 1, act] with T >= 2,"
                f" got {list(frames.shape)} and {list(steps.shape)}"
            )
        if frames.shape[1] != observations[0].shape[1] or steps.shape[1] != actions[0].shape[1]:
            raise ValueError(f"trajectory {index} has other columns than trajectory 0")
    lengths = [len(steps) for steps in actions]
    done = torch.zeros(sum(lengths), 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    return TensorDict(
        {
            keys.OBSERVATION: torch.cat([frames[:-1] for frames in observations]).to(dtype),
            keys.ACTION: torch.cat(actions).to(dtype),
            keys.HAS_ACTION: torch.ones_like(done),
            keys.EPISODE: torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths)),
            keys.STEP_COUNT: torch.cat([torch.arange(length) for length in lengths]),
            "next": {
                "observation": torch.cat([frames[1:] for frames in observations]).to(dtype),
                "done": done,
                "terminated": done.clone(),
                "truncated": torch.zeros_like(done),
            },
        },
        [sum(lengths)],
    )


def trajectory_lengths(data: TensorDictBase) -> torch.Tensor:
    """Number of steps of every trajectory, in the order in which they are stored.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``episode``.

    Returns:
        Tensor: int64 ``[number of trajectories]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import trajectory_lengths
        >>> trajectory_lengths(TensorDict({"episode": torch.tensor([4, 4, 4, 9])}, [4]))
        tensor([3, 1])
    """
    return torch.unique_consecutive(data.get(keys.EPISODE), return_counts=True)[1]


def select_state(
    data: TensorDictBase, columns: Iterable[int] | Callable[[torch.Tensor], torch.Tensor]
) -> TensorDictBase:
    """Adds ``state [N, d]``: the columns of the observation that planner and controller may see.

    Args:
        data (TensorDictBase): flat data ``[N]``; not changed.
        columns (iterable of int, or callable): columns to keep, or a function of observations ``[N, obs]`` such as
            ``get_task("sorting").state_of``.

    Returns:
        TensorDictBase: a shallow copy of ``data`` with ``state``.

    Raises:
        ValueError: if there is no such column, or none is asked for.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories, select_state
        >>> data = flatten_trajectories([torch.arange(8.0).reshape(2, 4)], [torch.ones(1, 2)])
        >>> select_state(data, (2, 3))["state"]
        tensor([[2., 3.]])
    """
    if callable(columns):
        return data.copy().set(keys.STATE, columns(data.get(keys.OBSERVATION)))
    columns = list(columns)
    width = data.get(keys.OBSERVATION).shape[-1]
    if not columns or not all(0 <= column < width for column in columns):
        raise ValueError(f"state columns must be one or more of 0..{width - 1}, got {columns}")
    return data.copy().set(keys.STATE, data.get(keys.OBSERVATION)[..., columns])


def controller_view(data: TensorDictBase, columns: Sequence[int]) -> TensorDictBase:
    """The same data as a controller with a mask sees them.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``state``; not changed.
        columns (sequence of int): columns of the state to keep.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import controller_view
        >>> controller_view(TensorDict({"state": torch.tensor([[1.0, 2.0, 3.0]])}, [1]), (0, 2))["state"]
        tensor([[1., 3.]])
    """
    return data.copy().set(keys.STATE, data.get(keys.STATE)[..., list(columns)])
