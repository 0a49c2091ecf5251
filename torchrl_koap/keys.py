# This source code is licensed under the MIT license found in the LICENSE file.
"""Names of all tensordict entries, the two layouts of data, and their validator.

Storage layout (TorchRL's TED, flat over steps; ``N`` steps of all trajectories one after the other)::

    observation            [N, obs]   float   what the environment returned before the step
    state                  [N, d]     float   the part of it that planner and controller may see (optional)
    action                 [N, act]   float   NaN where the label is not in the budget
    has_action             [N, 1]     bool    False where ``action`` is NaN
    label_command          [N, J]     float   the last command at labelled steps, else NaN (optional)
    episode                [N]        int64   trajectory index, constant inside a trajectory
    step_count             [N]        int64   0, 1, 2, ... inside a trajectory
    next/observation       [N, obs]   float
    next/done, terminated, truncated  [N, 1]  bool
    next/reward            [N, 1]     float   (optional)

Window layout (``T = history + horizon`` consecutive steps of one trajectory, "now" is frame ``history - 1``)::

    frame        0     1     2     3  ...  8   9  ...  15          (history = 2, horizon = 14, k = 8)
                 x_0   x_1   x_2   x_3     x_8 x_9     x_15
                 past  now   `------- planned (or recorded) future -------'
    action             a_1   a_2   a_3 ...             a_14        a_t moves x_t to x_{t+1}
    f for a_1    x_0   x_1                     x_{1+k}

Every entry of a window is ``[*B, T, ...]``; ``latent_action`` and ``action`` of frame ``t`` belong to the
transition from ``x_t`` to ``x_{t+1}``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from torchrl_koap.files import refuse

OBSERVATION = "observation"
STATE = "state"
ACTION = "action"
HAS_ACTION = "has_action"
LABEL_COMMAND = "label_command"
EPISODE = "episode"
STEP_COUNT = "step_count"
NEXT_OBSERVATION = ("next", "observation")
NEXT_DONE = ("next", "done")
NEXT_TERMINATED = ("next", "terminated")
NEXT_TRUNCATED = ("next", "truncated")
NEXT_REWARD = ("next", "reward")

_PART = 1 << 18  # steps that are checked at once: a check needs several times their memory

LIFTED_STATE = "lifted_state"
LATENT_ACTION = "latent_action"
HISTORY = "history"
PADDED = "padded"
PLAN = "plan"

SUCCESS = "success"
COLLISION = "collision"
FAILED = "failed"
MODE = "mode"
CONTEXT = "context"

_FLOATS = (OBSERVATION, STATE, ACTION, LABEL_COMMAND, NEXT_OBSERVATION, NEXT_REWARD)
_FLAGS = (HAS_ACTION, NEXT_DONE, NEXT_TERMINATED, NEXT_TRUNCATED)
_COUNTS = (EPISODE, STEP_COUNT)
REQUIRED = (OBSERVATION, ACTION, *_FLAGS, *_COUNTS, NEXT_OBSERVATION)


def read_entry(module: nn.Module, tensordict: TensorDictBase, key: NestedKey, rename: str = "in_key=...") -> Tensor:
    """Reads an entry for a module.

    Raises:
        KeyError: if the entry is missing; names the existing entries, and the call that renames keys (``rename``).
        ValueError: if its floating dtype differs from that of the module's weights.
    """
    value = tensordict.get(key, None)
    if value is None:
        there = sorted(tensordict.keys(True, True), key=str)
        raise KeyError(f"{type(module).__name__} reads {key!r}; there are {there}; rename with {rename}")
    check_type(module, value, key)
    return value


def check_type(module: nn.Module, value: Tensor, key: NestedKey) -> None:
    """Raises a ValueError if the floating dtype of an entry differs from that of a module's weights."""
    weight = next(module.parameters(), None)
    if weight is not None and value.is_floating_point() and value.dtype != weight.dtype:
        name = type(module).__name__
        raise ValueError(
            f"{key!r} is {value.dtype}, {name} {weight.dtype}: cast one of them, as with .to({weight.dtype})"
        )


def observed_numbers(given: Any) -> Tensor:
    """Converts an observation to a float64 tensor, masked values and None to NaN; returns tensors unchanged."""
    if isinstance(given, Tensor):
        return given
    try:
        array = np.ma.array(given, copy=True)
        if array.ndim and array.dtype.kind in "fiubO":
            return torch.from_numpy(np.ascontiguousarray(array.astype(np.float64).filled(np.nan)))
    except (TypeError, ValueError):  # ragged lists, other objects
        pass
    raise ValueError(f"an observation must be numbers [obs] or [n, obs], got {type(given).__name__}")


def frame_mask(mask: Tensor | None, name: object, state: Tensor) -> Tensor:
    """Checks a mask ``[*B, T]`` or ``[*B, T, 1]`` of the frames of windows ``[*B, T, d]``; returns ``[*B, T]``."""
    frames = state.shape[:-1]
    if mask is None or mask.shape not in (frames, (*frames, 1)) or mask.dtype != torch.bool:
        got = "None: hand in 'has_action'" if mask is None else f"{mask.dtype} {list(mask.shape)}"
        cast = "" if mask is None or mask.dtype == torch.bool else "; cast it with .bool()"
        raise ValueError(f"{name} must be bool {[*frames, 1]} or {list(frames)}, got {got}{cast}")
    return mask.reshape(frames)


def check_actions(action: Tensor, key: NestedKey, state: Tensor) -> Tensor:
    """Returns actions ``[*B, T, act]`` of windows ``[*B, T, d]``; raises a ValueError if ``[*B, T]`` differ."""
    if action.shape[:-1] != state.shape[:-1]:
        frames = f"the batch and frames {list(state.shape[:-1])} of the states, then columns"
        raise ValueError(f"{key!r} must have {frames}, got {list(action.shape)}")
    return action


def check_window(tensordict: TensorDictBase, key: NestedKey, state: Tensor) -> Tensor:
    """Returns states ``[*B, T, d]``.

    Raises:
        ValueError: if states ``[T, d]`` are of several trajectories: ``episode`` changes, or another state follows a
            step that is done. A flat batch of steps would be read as one window.
    """
    if state.ndim != 2 or torch.compiler.is_compiling():
        return state
    episode, done = tensordict.get(EPISODE, None), tensordict.get(NEXT_DONE, None)
    several: NestedKey | None = EPISODE if episode is not None and len(episode.unique()) > 1 else None
    if done is not None and done.numel() == len(state):  # one flag per frame
        moved = (state[1:] != state[:-1]).any(-1)
        if (done.reshape(-1)[:-1] & moved).any():
            several = several or NEXT_DONE
    if several is not None:
        flat = f"{key!r} {list(state.shape)} is one window, but its steps are of several trajectories ({several!r})"
        raise ValueError(f"{flat}; reshape a flat batch, such as SliceSampler's, to [B, T]")
    return state


def validate(data: TensorDictBase, *, command: slice | None = None) -> TensorDictBase:
    """Checks a flat tensordict against the storage layout and returns it unchanged.

    Args:
        data (TensorDictBase): flat data, ``batch_size == [N]``.
        command (slice, optional): columns of the observation that may all be NaN in a step, because
            :func:`~torchrl_koap.data.label_budget.hide_commands` hid them. Default: none.

    Raises:
        DataError: with *all* problems: missing keys, wrong dtypes or shapes, non-finite states, NaN labels where
            ``has_action`` is True (or, a leak, numbers where it is False), step counts that do not restart with the
            trajectory, trajectories that are not contiguous.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.files import DataError
        >>> from torchrl_koap.keys import validate
        >>> try:
        ...     validate(TensorDict({"observation": torch.zeros(3, 2)}, [3]))
        ... except DataError as error:
        ...     print(error.problems[0])
        missing key 'action'
    """
    if data.batch_dims != 1:
        problems = [f"batch size must be [N] (flat over steps), got {list(data.batch_size)}"]
    elif not len(data):
        problems = ["there are no steps (batch size [0])"]
    else:
        present = set(data.keys(include_nested=True, leaves_only=True))
        problems = [f"missing key {key!r}" for key in REQUIRED if key not in present]
        problems += _shape_problems(data, present)
        if not problems:  # checks of values compare entries with each other and need all of them
            problems = list(_value_problems(data, present, command))
    refuse("data that do not follow the storage layout", problems)
    return data


def _shape_problems(data: TensorDictBase, present: set) -> Iterator[str]:
    steps = len(data)
    kinds = (
        ("a float tensor [N, d]", _FLOATS, lambda value: value.ndim == 2 and value.is_floating_point()),
        ("a bool tensor [N, 1]", _FLAGS, lambda value: value.dtype == torch.bool and value.shape == (steps, 1)),
        ("an int64 tensor [N]", _COUNTS, lambda value: value.dtype == torch.int64 and value.shape == (steps,)),
    )
    for wanted, names, fits in kinds:
        for key in names:
            if key in present and not fits(value := data.get(key)):
                yield f"{key!r} must be {wanted}, got {value.dtype} {list(value.shape)}"


def _value_problems(data: TensorDictBase, present: set, command: slice | None) -> Iterator[str]:
    width, next_width = data.get(OBSERVATION).shape[-1], data.get(NEXT_OBSERVATION).shape[-1]
    if width != next_width:
        yield f"'observation' has {width} columns, {NEXT_OBSERVATION!r} has {next_width}"
    wrong: dict[str, Tensor] = {}  # which steps have a fault, bool [N]
    for key in (OBSERVATION, STATE, NEXT_OBSERVATION):
        if key in present:
            allowed, parts = command if key != STATE else None, data.get(key).split(_PART)
            wrong[f"{key!r} is NaN or infinite"] = torch.cat([_not_finite(values, allowed) for values in parts])

    action, has_action = data.get(ACTION), data.get(HAS_ACTION).squeeze(-1)
    wrong["a labelled 'action' is not finite"] = has_action & ~action.isfinite().all(-1)
    leaked = "an unlabelled 'action' holds numbers (an action outside the label budget must be NaN)"
    wrong[leaked] = ~has_action & ~action.isnan().all(-1)

    episode, step_count = data.get(EPISODE), data.get(STEP_COUNT)
    same = episode[1:] == episode[:-1]
    edge = torch.ones(1, dtype=torch.bool, device=same.device)
    starts, ends = torch.cat([edge, ~same]), torch.cat([~same, edge])
    if int(starts.sum()) != episode[starts].unique().numel():
        yield "'episode': the steps of a trajectory must lie one after the other"
    miscounted = starts & (step_count != 0)
    miscounted[1:] |= same & (step_count[1:] != step_count[:-1] + 1)
    wrong["'step_count' does not count 0, 1, 2, ... in its trajectory"] = miscounted

    done = data.get(NEXT_DONE).squeeze(-1)
    wrong["('next', 'done') is False at the end of a trajectory"] = ends & ~done
    wrong["('next', 'done') is True inside a trajectory"] = done & ~ends
    stopped = (data.get(NEXT_TERMINATED) | data.get(NEXT_TRUNCATED)).squeeze(-1)
    wrong["('next', 'done') is not 'terminated or truncated'"] = done != stopped
    for said, steps in wrong.items():
        if steps.any():
            yield f"{said} in {int(steps.sum())} steps, first at step {int(steps.nonzero()[0])}"


def _not_finite(values: Tensor, allowed: slice | None) -> Tensor:
    """Returns which rows hold NaN or infinite values; in a row, the ``allowed`` columns may all be NaN."""
    bad_entries = ~values.isfinite()
    if allowed is not None:
        bad_entries[:, allowed] &= ~values[:, allowed].isnan().all(-1, keepdim=True)
    return bad_entries.any(-1)
