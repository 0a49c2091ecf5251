# This source code is licensed under the MIT license found in the LICENSE file.
"""Trajectories of any robot as plain arrays, before they become a data set: what every reader hands over, checked once.

A trajectory of ``T`` frames has ``T - 1`` transitions. Whoever logs an action beside every frame has ``T`` actions; the
last one leads to a frame that was not recorded and is dropped. A trajectory without actions, and every step whose
action is NaN, has no label.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import ArrayLike

from torchrl_koap.data.formats.frames import Clip
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
        skipped (tuple of str): entries of the source that were left out.
        cameras (dict): by camera for every trajectory where its ``T_i`` frames lie.

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
    cameras: Mapping[str, Sequence[Clip]] = field(default_factory=dict)

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
    cameras: Mapping[str, Sequence[Clip]] | None = None,
    source: str = "these recordings",
) -> Recordings:
    """Checks arrays and puts them into one form.

    Args:
        states (sequence of array): frames of every trajectory ``[T_i, d]``.
        actions (sequence of array or None, optional): actions ``[T_i, a]`` or ``[T_i - 1, a]`` of every trajectory, or
            None for one without; None for no labels at all.

    Keyword Args:
        action_dim (int, optional): number of action columns, needed where no trajectory has actions.
        state_names, action_names, sources, control_hz, skipped, cameras: as of :class:`Recordings`. Columns and
            trajectories without a name are numbered.
        source (str): what messages call the whole.

    Returns:
        Recordings: checked, with names.

    Raises:
        DataError: with all faults: no trajectories, other widths than in the first, fewer than two frames, states
            that are no numbers or not finite, infinite actions, a number of actions that is neither ``T`` nor
            ``T - 1``, an action column with few numbers, names that do not fit.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_recordings
        >>> recordings = make_recordings([np.zeros((5, 3)), np.zeros((4, 3))], [np.ones((5, 2)), None])
        >>> [steps.shape for steps in recordings.actions], recordings.num_labels
        ([(4, 2), (3, 2)], 4)
    """
    problems: list[str] = []
    if not len(states):
        raise DataError(source, "there are no trajectories")
    actions = [None] * len(states) if actions is None else actions
    if len(actions) != len(states):
        raise DataError(source, f"{len(states)} trajectories of states, {len(actions)} of actions")
    labels = [str(index) for index in range(len(states))] if sources is None else list(sources)
    what = [f"trajectory {label}" for label in labels]
    frames = [_frames(value, name, problems) for value, name in zip(states, what, strict=True)]
    width = next((array.shape[1] for array in frames if array is not None), 0)
    known = [_steps(value, name, problems) for value, name in zip(actions, what, strict=True)]
    wide = next((array.shape[1] for array in known if array is not None), action_dim)
    if wide is None and action_names is not None:
        wide = len(action_names)
    if wide is None:
        problems.append("no trajectory has actions: action_dim says how many columns an action has")
        wide = 1
    elif action_dim is not None and action_dim != wide:
        problems.append(f"actions have {wide} columns, action_dim says {action_dim}")
    for name, seen, done in zip(what, frames, known, strict=True):
        if seen is None:
            continue
        length = len(seen)
        if seen.shape[1] != width:
            problems.append(f"{name}: states have {seen.shape[1]} columns, those before have {width}")
        if done is not None and done.shape[1] != wide:
            problems.append(f"{name}: actions have {done.shape[1]} columns, those before have {wide}")
        elif done is not None and len(done) not in (length - 1, length):
            problems.append(
                f"{name}: {len(done)} actions for {length} frames; wanted one per frame ({length}) or one per"
                f" transition ({length - 1})"
            )
    given_states = _names(state_names, width, "state", problems)
    given_actions = _names(action_names, wide, "action", problems)
    problems += _sparse([array for array in known if array is not None and array.shape[1] == wide], given_actions)
    if control_hz is not None and not (isinstance(control_hz, (int, float, np.number)) and 0 < control_hz < math.inf):
        problems.append(f"control_hz must be a positive number of frames per second, got {control_hz!r}")
    if problems:
        raise DataError(source, problems)
    steps = [
        np.full((len(seen) - 1, wide), np.nan) if done is None else _whole(done[: len(seen) - 1])
        for seen, done in zip(frames, known, strict=True)
    ]
    unknown = [np.isnan(array).sum(-1) for array in known if array is not None]
    partly = sum(int(((0 < columns) & (columns < wide)).sum()) for columns in unknown)
    skipped = [*skipped, *([f"{partly} actions of which only some columns are known"] if partly else [])]
    return Recordings(
        frames,
        steps,
        given_states,
        given_actions,
        tuple(labels),
        control_hz,
        tuple(dict.fromkeys(skipped)),
        dict(cameras or {}),
    )


def _frames(value: ArrayLike, name: str, problems: list[str]) -> np.ndarray | None:
    array = _table(value, f"{name}: states", "[T, d]", problems)
    if array is None:
        return None
    if array.dtype.kind not in "fiub":
        problems.append(f"{name}: states are {array.dtype}, wanted numbers in the unit that the robot reports")
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
    array = None if value is None else _table(value, f"{name}: actions", "[T, a] or [T - 1, a]", problems)
    if array is None:
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


def _table(value: ArrayLike, name: str, wanted: str, problems: list[str]) -> np.ndarray | None:
    try:
        array = value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
    except ValueError:
        widths = sorted({np.size(row) for row in value})  # type: ignore[union-attr, arg-type]
        problems.append(f"{name} are lists of different lengths: rows of {' and '.join(map(str, widths))} numbers")
        return None
    if array.ndim == 2 and array.shape[-1]:
        return array
    problems.append(f"{name} must be {wanted}, got {list(array.shape)}")
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


def _whole(steps: np.ndarray) -> np.ndarray:
    """An action of which some columns are unknown is unknown."""
    return np.where(np.isnan(steps).any(-1, keepdims=True), np.nan, steps)


def _names(given: Sequence[str] | None, width: int, kind: str, problems: list[str]) -> tuple[str, ...]:
    if given is None:
        return tuple(f"{kind}_{index}" for index in range(width))
    names = tuple(str(name) for name in given)
    if not all(name.strip() for name in names):
        problems.append(f"{kind}_names holds an empty name")
    if len(names) != width:
        problems.append(f"{kind}_names names {len(names)} columns, there are {width}")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        problems.append(f"{kind}_names holds {', '.join(repeated)} more than once")
    return names
