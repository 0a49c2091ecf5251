# This source code is licensed under the MIT license found in the LICENSE file.
"""Trajectories of any robot as plain arrays, before they become a data set: what every reader hands over, checked once.

A trajectory of ``T`` frames has ``T - 1`` transitions. Whoever logs an action beside every frame has ``T`` actions; the
last one leads to a frame that was not recorded and is dropped. A trajectory without actions, and every step whose
action is NaN, has no label.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike

from torchrl_koap.files import DataError


@dataclass(frozen=True)
class Recordings:
    """Trajectories as arrays, with the names of their columns.

    Args:
        states (list of np.ndarray): frames of every trajectory ``[T_i, d]``, float64.
        actions (list of np.ndarray): actions of every trajectory ``[T_i - 1, a]``, float64; NaN rows have no label.
        state_names (tuple of str): names of the ``d`` state columns.
        action_names (tuple of str): names of the ``a`` action columns.
        sources (tuple of str): where each trajectory is from, for messages.
        control_hz (float, optional): frames per second, if the source says so.
        skipped (tuple of str): entries of the source that were left out, images for example.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_recordings
        >>> recordings = make_recordings([np.zeros((5, 3))], [np.ones((5, 2))], control_hz=30.0)
        >>> recordings.state_names, recordings.num_labels
        (('state_0', 'state_1', 'state_2'), 4)
    """

    states: list[np.ndarray]
    actions: list[np.ndarray]
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    sources: tuple[str, ...]
    control_hz: float | None = None
    skipped: tuple[str, ...] = field(default=())

    @property
    def num_labels(self) -> int:
        """Number of transitions with an action."""
        return sum(int(np.isfinite(steps).all(-1).sum()) for steps in self.actions)


def make_recordings(
    states: Sequence[ArrayLike],
    actions: Sequence[ArrayLike | None] | None = None,
    *,
    action_dim: int | None = None,
    state_names: Sequence[str] | None = None,
    action_names: Sequence[str] | None = None,
    sources: Sequence[str] | None = None,
    control_hz: float | None = None,
    skipped: Sequence[str] = (),
    source: str = "these recordings",
) -> Recordings:
    """Checks arrays and puts them into one form.

    Args:
        states (sequence of array): frames of every trajectory ``[T_i, d]``, floating point.
        actions (sequence of array or None, optional): actions ``[T_i, a]`` or ``[T_i - 1, a]`` of every trajectory, or
            None for one without; None for no labels at all.

    Keyword Args:
        action_dim (int, optional): number of action columns, needed where no trajectory has actions.
        state_names (sequence of str, optional): names of the state columns. Default: ``state_0``, ...
        action_names (sequence of str, optional): names of the action columns. Default: ``action_0``, ...
        sources (sequence of str, optional): what messages call each trajectory. Default: its number.
        control_hz (float, optional): frames per second.
        skipped (sequence of str): entries that the caller left out.
        source (str): what messages call the whole.

    Returns:
        Recordings: checked, with names and units.

    Raises:
        DataError: with all faults: no trajectories, other widths than in the first, fewer than two frames,
            integers where floating-point numbers are wanted, states that are not finite, infinite actions, a number of
            actions that is neither ``T`` nor ``T - 1``, an action column with few numbers, names that do not fit.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_recordings
        >>> recordings = make_recordings([np.zeros((5, 3)), np.zeros((4, 3))], [np.ones((5, 2)), None])
        >>> [steps.shape for steps in recordings.actions], recordings.num_labels
        ([(4, 2), (3, 2)], 4)
    """
    problems: list[str] = []
    if not len(states):
        raise DataError(source, ["there are no trajectories"])
    if actions is None:
        actions = [None] * len(states)
    if len(actions) != len(states):
        raise DataError(source, [f"{len(states)} trajectories of states, {len(actions)} of actions"])
    labels = [str(index) for index in range(len(states))] if sources is None else list(sources)
    what = [f"trajectory {label}" for label in labels]
    frames = [_frames(value, name, problems) for value, name in zip(states, what, strict=True)]
    width = next((array.shape[1] for array in frames if array is not None), 0)
    steps = [_steps(value, name, problems) for value, name in zip(actions, what, strict=True)]
    whole = list(steps)
    wide = next((array.shape[1] for array in steps if array is not None), action_dim)
    if wide is None:
        wide = len(action_names) if action_names is not None else None
    if wide is None:
        problems.append("no trajectory has actions: action_dim says how many columns an action has")
        wide = 1
    elif action_dim is not None and action_dim != wide:
        problems.append(f"actions have {wide} columns, action_dim says {action_dim}")
    for index, name in enumerate(what):
        if frames[index] is None:
            continue
        length = len(frames[index])
        if frames[index].shape[1] != width:
            problems.append(f"{name}: states have {frames[index].shape[1]} columns, those before have {width}")
        if steps[index] is None:
            steps[index] = np.full((length - 1, wide), np.nan)
        elif steps[index].shape[1] != wide:
            problems.append(f"{name}: actions have {steps[index].shape[1]} columns, those before have {wide}")
        elif len(steps[index]) not in (length - 1, length):
            problems.append(
                f"{name}: {len(steps[index])} actions for {length} frames; wanted one per frame ({length}) or one per"
                f" transition ({length - 1})"
            )
        else:
            steps[index] = _without_rest(steps[index][: length - 1])
    given_states = _names(state_names, width, "state", problems)
    given_actions = _names(action_names, wide, "action", problems)
    problems += _sparse([array for array in whole if array is not None and array.shape[1] == wide], given_actions)
    if control_hz is not None and not (np.isfinite(control_hz) and control_hz > 0):
        problems.append(f"control_hz must be a positive number of frames per second, got {control_hz!r}")
    if problems:
        raise DataError(source, problems)
    return Recordings(
        frames, steps, given_states, given_actions, tuple(labels), control_hz, tuple(dict.fromkeys(skipped))
    )


def _frames(value: ArrayLike, name: str, problems: list[str]) -> np.ndarray | None:
    array = _array(value, f"{name}: states", problems)
    if array is None:
        return None
    array = array.astype(np.float64) if array.dtype == bool else array
    if array.ndim != 2 or not array.shape[-1]:
        problems.append(f"{name}: states must be [T, d], got {list(array.shape)}")
    elif not np.issubdtype(array.dtype, np.floating):
        problems.append(
            f"{name}: states are {array.dtype}; wanted floating-point numbers in the unit that the robot reports"
        )
    elif len(array) < 2:
        problems.append(f"{name}: {len(array)} frame; a transition needs two")
    else:
        bad = ~np.isfinite(array).all(-1)
        if bad.any():
            columns = np.flatnonzero(~np.isfinite(array).all(0)).tolist()
            problems.append(f"{name}: states are not finite at frame {int(bad.argmax())}, columns {columns}")
        return array.astype(np.float64)
    return None


def _steps(value: ArrayLike | None, name: str, problems: list[str]) -> np.ndarray | None:
    array = None if value is None else _array(value, f"{name}: actions", problems)
    if array is None:
        return None
    if array.ndim != 2 or not array.shape[-1]:
        problems.append(f"{name}: actions must be [T, a] or [T - 1, a], got {list(array.shape)}")
        return None
    if array.dtype.kind not in "fiub":
        problems.append(f"{name}: actions are {array.dtype}, wanted numbers")
        return None
    array = array.astype(np.float64)
    infinite = np.isinf(array).any(-1)
    if infinite.any():
        problems.append(
            f"{name}: the action of step {int(infinite.argmax())} is infinite; NaN means that it is unknown"
        )
    return array


def _array(value: ArrayLike, name: str, problems: list[str]) -> np.ndarray | None:
    try:
        return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    except ValueError:
        widths = sorted({np.size(row) for row in value})  # type: ignore[union-attr, arg-type]
        problems.append(f"{name} are lists of different lengths: rows of {' and '.join(map(str, widths))} numbers")
        return None


def _sparse(actions: Sequence[np.ndarray], names: Sequence[str]) -> list[str]:
    """Names action columns that are known in less than half of the steps in which another one is."""
    known = np.isfinite(np.concatenate(actions)).sum(0) if actions else np.zeros(0, dtype=int)
    sparse = [
        f"{name!r} (known in {count})" for name, count in zip(names, known, strict=False) if 2 * count < known.max()
    ]
    if not sparse:
        return []
    return [
        f"{known.max()} steps have actions, but action column {', '.join(sparse)} is mostly empty, and only steps in"
        " which all columns are known are labels: repeat its last value where it holds on, or drop it (drop_columns)"
    ]


def _without_rest(steps: np.ndarray) -> np.ndarray:
    """An action of which some columns are unknown is unknown."""
    return np.where(np.isnan(steps).any(-1, keepdims=True), np.nan, steps)


def _names(given: Sequence[str] | None, width: int, kind: str, problems: list[str]) -> tuple[str, ...]:
    if given is None:
        return tuple(f"{kind}_{index}" for index in range(width))
    names = tuple(str(name) for name in given)
    if len(names) != width:
        problems.append(f"{kind}_names names {len(names)} columns, there are {width}")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        problems.append(f"{kind}_names holds {', '.join(repeated)} more than once")
    return names
