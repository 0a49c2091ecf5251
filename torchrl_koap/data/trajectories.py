# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts separate trajectories to the flat storage layout, and selects the columns a policy may see."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_koap import keys

_VELOCITY = 3  # steps over which the last velocity is averaged


def flatten_trajectories(
    observations: Sequence[torch.Tensor | np.ndarray],
    actions: Sequence[torch.Tensor | np.ndarray | None] | None,
    *,
    action_dim: int | None = None,
    dtype: torch.dtype = torch.float32,
) -> TensorDict:
    """Concatenates recorded trajectories in the storage layout.

    ``T`` frames make ``T - 1`` steps: step ``t`` goes from frame ``t`` to frame ``t + 1``. The last step of every
    trajectory is marked as terminated. A step has a label if its action is given. Missing actions are ``None`` for a
    trajectory, or a row of NaN.

    Args:
        observations (sequence of Tensor or array): frames ``[T_i, obs]`` of each trajectory.
        actions (sequence of Tensor, array or None): actions ``[T_i - 1, act]`` of each trajectory, or None. None
            instead of the sequence: no trajectory has actions.

    Keyword Args:
        action_dim (int, optional): size of an action; required if no trajectory has actions.
        dtype (torch.dtype): floating type of the entries.

    Returns:
        TensorDict: flat data ``[sum(T_i - 1)]``.

    Raises:
        ValueError: if numbers of trajectories, frames or columns do not match, or an action is infinite or partly NaN.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories
        >>> data = flatten_trajectories([torch.arange(8.0).reshape(4, 2)], [torch.ones(3, 1)])
        >>> data["observation"][1], data["next", "observation"][1], data["next", "done"].squeeze(-1)
        (tensor([2., 3.]), tensor([4., 5.]), tensor([False, False,  True]))
    """
    observations = [torch.as_tensor(frames) for frames in observations]
    actions = [None] * len(observations) if actions is None else actions
    actions = [None if steps is None else torch.as_tensor(steps) for steps in actions]
    if not observations or len(observations) != len(actions):
        raise ValueError(f"{len(observations)} trajectories of observations, {len(actions)} of actions")
    given = next((steps for steps in actions if steps is not None), None)
    if given is None and action_dim is None:
        raise ValueError("no trajectory has actions: action_dim is needed")
    width = (1, *given.shape)[-1] if action_dim is None else action_dim
    for index, (frames, steps) in enumerate(zip(observations, actions, strict=True)):
        if frames.ndim == 2 and steps is None:
            actions[index] = steps = torch.full((max(len(frames) - 1, 0), width), torch.nan, dtype=dtype)
        if frames.ndim != 2 or steps is None or steps.ndim != 2 or len(frames) < 2 or len(steps) != len(frames) - 1:
            raise ValueError(
                f"trajectory {index}: wanted observations [T, obs] and actions [T - 1, act] with T >= 2,"
                f" got {list(frames.shape)} and {None if steps is None else list(steps.shape)}"
            )
        if frames.shape[1] != observations[0].shape[1] or steps.shape[1] != width:
            raise ValueError(
                f"trajectory {index} has {frames.shape[1]} observation and {steps.shape[1]} action columns,"
                f" wanted {observations[0].shape[1]} and {width}"
            )
        bad = steps.isinf().any(-1) | (steps.isnan().any(-1) & ~steps.isnan().all(-1))
        if bad.any():
            raise ValueError(
                f"trajectory {index}: {int(bad.sum())} actions are infinite or NaN in some entries only, first at step"
                f" {int(bad.nonzero()[0])}; a missing action is NaN in all entries"
            )
    lengths = [len(steps) for steps in actions]
    done = torch.zeros(sum(lengths), 1, dtype=torch.bool)
    done[torch.tensor(lengths).cumsum(0) - 1] = True
    return TensorDict(
        {
            keys.OBSERVATION: torch.cat([frames[:-1] for frames in observations]).to(dtype),
            keys.ACTION: torch.cat(actions).to(dtype),
            keys.HAS_ACTION: ~torch.cat([steps.isnan().all(-1, keepdim=True) for steps in actions]),
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


def mark_labels(data: TensorDictBase, *, action_dim: int | None = None) -> TensorDictBase:
    """Adds ``has_action [N, 1]`` to a shallow copy of flat data: True unless a row of ``action`` is all NaN.

    If the entry ``action`` is missing, NaN actions of ``action_dim`` columns are added.

    Raises:
        ValueError: if there is no ``action`` and no ``action_dim``.
    """
    data, action = data.copy(), data.get(keys.ACTION, None)
    if action is None:
        if action_dim is None:
            raise ValueError("the data have no entry 'action', and thus no labels: action_dim is needed")
        action = torch.full((*data.batch_size, action_dim), torch.nan, device=data.device)
    return data.set(keys.ACTION, action).set(keys.HAS_ACTION, ~action.isnan().all(-1, keepdim=True))


def trajectory_lengths(data: TensorDictBase) -> torch.Tensor:
    """Returns the number of steps of every trajectory of flat data, int64 ``[trajectories]``, in their order."""
    return torch.unique_consecutive(data.get(keys.EPISODE), return_counts=True)[1]


def begins(data: TensorDictBase) -> torch.Tensor:
    """Returns which steps of flat data begin a trajectory, bool ``[N]``."""
    episode = data.get(keys.EPISODE)
    return episode.diff(prepend=episode[:1] - 1) != 0


def labelled_episodes(data: TensorDictBase) -> torch.Tensor:
    """Returns the numbers of trajectories of flat data that have a label, int64 ``[k]``, ascending."""
    return data.get(keys.EPISODE)[data.get(keys.HAS_ACTION).squeeze(-1)].unique()


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
        ValueError: if a column does not exist, or ``columns`` is empty.

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


def extrapolate_ends(data: TensorDictBase, frames: int) -> TensorDict:
    """Continues every trajectory at its last mean velocity, so that windows near the end have planned frames.

    Args:
        data (TensorDictBase): flat data ``[N]`` with ``state`` and ``episode``.
        frames (int): frames to append to each trajectory.

    Returns:
        TensorDict: ``state`` and ``episode``, flat ``[N + trajectories * frames]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import extrapolate_ends
        >>> line = TensorDict({"state": torch.arange(5.0)[:, None], "episode": torch.zeros(5, dtype=torch.int64)}, [5])
        >>> extrapolate_ends(line, 2)["state"].flatten().tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    lengths = trajectory_lengths(data).tolist()
    states, episodes = [], []
    for state, episode in zip(data.get(keys.STATE).split(lengths), data.get(keys.EPISODE).split(lengths), strict=True):
        steps = min(_VELOCITY, len(state) - 1)
        velocity = (state[-1] - state[-1 - steps]) / max(steps, 1)
        ahead = torch.arange(1, frames + 1, dtype=state.dtype, device=state.device)[:, None]
        states.append(torch.cat([state, state[-1] + ahead * velocity]))
        episodes.append(episode[:1].expand(len(state) + frames))
    states = torch.cat(states)
    found = {keys.STATE: states, keys.EPISODE: torch.cat(episodes)}
    return TensorDict(found, batch_size=[len(states)], device=data.device)
