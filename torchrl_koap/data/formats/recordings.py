# This source code is licensed under the MIT license found in the LICENSE file.
"""Trajectories of any robot as plain arrays: the result of every reader, checked before it becomes a data set.

A trajectory of ``T`` frames has ``T - 1`` transitions. If an action was logged with every frame, the last of the ``T``
actions leads to an unrecorded frame and is dropped. Trajectories without actions and steps with NaN have no label.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike

from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.files import DataError, gathered, option, refuse, some

_COARSE = 1e-5  # of the range of a column
FRAMES, STEPS = "[T, d]", "[T, a] or [T - 1, a]"


@runtime_checkable
class _DataFrame(Protocol):
    """A data frame of pandas or another package."""

    columns: Any  # names
    shape: Any


@dataclass(frozen=True)
class Recordings:
    """Trajectories as float64 arrays, with the names of their columns.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_recordings
        >>> recordings = make_recordings([np.zeros((5, 3))], [np.ones((5, 2))], control_hz=30.0)
        >>> recordings.state_names, recordings.num_labels
        (('state_0', 'state_1', 'state_2'), 4)
    """

    states: list[np.ndarray]  # frames of every trajectory [T_i, d]
    actions: list[np.ndarray]  # of every trajectory [T_i - 1, a]; NaN rows have no label
    state_names: tuple[str, ...]  # of the d columns
    action_names: tuple[str, ...]  # of the a columns
    sources: tuple[str, ...]  # origin of each trajectory, for messages
    control_hz: float | None = None  # frames per second, if the source declares it
    skipped: tuple[str, ...] = ()  # entries of the source that were left out
    cameras: Mapping[str, Sequence[Clip]] = field(default_factory=dict)  # references to T_i frames of every trajectory

    @property
    def num_labels(self) -> int:
        """Number of transitions with an action."""
        return sum(int(np.isfinite(steps).all(-1).sum()) for steps in self.actions)

    @property
    def moving(self) -> np.ndarray:
        """Which state columns change within any recording (goals do not): bool ``[d]``."""
        return np.any([(frames[1:] != frames[:-1]).any(0) for frames in self.states], axis=0)

    def filmed(self, spans: Iterable[tuple[int, Sequence[int] | np.ndarray]]) -> dict[str, list[Clip]]:
        """Selects camera frames by pairs of trajectory number and rows."""
        chosen = list(spans)
        return {name: [clips[number].take(rows) for number, rows in chosen] for name, clips in self.cameras.items()}

    def cut(self, spans: Sequence[tuple[int, int, int]], skipped: Sequence[str]) -> Recordings:
        """Keeps only the given spans: trajectory number, first frame, and end (exclusive)."""
        return replace(
            self,
            states=[self.states[number][start:end] for number, start, end in spans],
            actions=[self.actions[number][start : end - 1] for number, start, end in spans],
            sources=tuple(self.sources[number] for number, *_ in spans),
            cameras=self.filmed((number, range(start, end)) for number, start, end in spans),
            skipped=(*self.skipped, *skipped),
        )


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
    """Checks arrays and returns them as :class:`Recordings`.

    Args:
        states (sequence of array): frames of every trajectory ``[T_i, d]``.
        actions (sequence of array or None, optional): actions ``[T_i, a]`` or ``[T_i - 1, a]`` of every trajectory, or
            None or an empty array for one without; None for no labels at all. Columns of data frames are matched by
            name.

    Keyword Args:
        action_dim (int, optional): number of action columns; required if no trajectory has actions.
        state_names, action_names, sources, control_hz, skipped, cameras: as in :class:`Recordings`. Columns and
            trajectories without a name are numbered.
        source (str): name of the recordings in messages.

    Returns:
        Recordings: checked, with names.

    Raises:
        DataError: listing all faults: no trajectories, other widths than in the first, fewer than two frames, states
            that are not finite numbers, infinite actions, neither ``T`` nor ``T - 1`` actions, action columns that are
            mostly empty, names that do not match.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_recordings
        >>> recordings = make_recordings([np.zeros((5, 3)), np.zeros((4, 3))], [np.ones((5, 2)), None])
        >>> [steps.shape for steps in recordings.actions], recordings.num_labels
        ([(4, 2), (3, 2)], 4)
    """
    states = _listed(states, "states", FRAMES, source)
    actions = [None] * len(states) if actions is None else _listed(actions, "actions", STEPS, source)
    if not states:
        raise DataError(source, "there are no trajectories")
    if len(actions) != len(states):
        raise DataError(source, f"{len(states)} trajectories of states, {len(actions)} of actions")
    labels = [str(index) for index in range(len(states))] if sources is None else list(sources)
    faults: list[tuple[str, str]] = []
    what = [f"trajectory {label}" for label in labels]
    states, state_names = _by_name(states, state_names, "states", what, faults)
    actions, action_names = _by_name(actions, action_names, "actions", what, faults)
    frames = [_table(value, "states", FRAMES, name, faults) for value, name in zip(states, what, strict=True)]
    width = next((array.shape[1] for array in frames if array is not None), 0)
    known = [
        None if value is None else _table(value, "actions", STEPS, name, faults)
        for value, name in zip(actions, what, strict=True)
    ]
    problems: list[str] = []
    wide = _action_width(known, action_dim, action_names, source, problems, told=bool(faults))
    given_states = _names(state_names, width, "state", problems)
    given_actions = _names(action_names, wide, "action", problems)
    lost: list[tuple[str, str]] = []
    for name, state, action in zip(what, frames, known, strict=True):
        faults += [(name, said) for said in (*_state_faults(state, width), *_action_faults(action, state, wide))]
        if state is not None and state.shape[1] == width and not np.isfinite(state).all():
            frame, column = np.argwhere(~np.isfinite(state))[0]
            called = repr(given_states[column]) if len(given_states) == width else column
            lost.append((name, f"frame {frame} in column {called}"))
    if lost:
        said = f"{some([name for name, _ in lost])}: states are not finite, first at {lost[0][1]}"
        problems.append(f"{said}: fill them, or {option('resample')} recordings without actions, which skips them")
    problems += _sparse([array for array in known if array is not None and array.shape[1] == wide], given_actions)
    if control_hz is not None:
        problems += wrong_rate(control_hz, "control_hz")
    refuse(source, [*gathered(faults), *problems])
    steps = [
        np.full((len(state) - 1, wide), np.nan) if action is None else action[: len(state) - 1]
        for state, action in zip(frames, known, strict=True)
    ]
    # an action with an unknown column counts as unknown
    partly = [int((np.isnan(part).any(-1) & ~np.isnan(part).all(-1)).sum()) for part in steps]
    where = some([f"{number} in {name}" for number, name in zip(partly, what, strict=True) if number])
    steps = [np.where(np.isnan(part).any(-1, keepdims=True), np.nan, part) for part in steps]
    skipped = [*skipped, *([f"actions of which only some columns are known ({where})"] if where else [])]
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


def _action_width(
    actions: Sequence[np.ndarray | None],
    action_dim: Any,
    names: Sequence[str] | None,
    source: str,
    problems: list[str],
    *,
    told: bool,
) -> int:
    """Returns the number of action columns; adds a problem if it differs, or is unknown and no faults were ``told``."""
    whole = isinstance(action_dim, (int, np.integer)) and not isinstance(action_dim, bool)
    if action_dim is not None and not (whole and action_dim > 0):
        raise DataError(source, f"{option('action_dim')} must be a positive whole number, got {action_dim!r}")
    wide = next((array.shape[1] for array in actions if array is not None), action_dim)
    if wide is None and names is None:
        cure = f"give the number of action columns in {option('action_dim')}, or the action columns of tables in"
        problems += [] if told else [f"no trajectory has actions: {cure} {option('action_columns')}"]
        return 1
    wide = len(names) if wide is None else wide
    if action_dim not in (None, wide):
        problems.append(f"actions have {wide} columns, {option('action_dim')} says {action_dim}")
    return wide


def _state_faults(state: np.ndarray | None, width: int) -> Iterator[str]:
    if state is not None and state.shape[1] != width:
        yield f"states have {state.shape[1]} columns, those before have {width}"
    elif state is not None and len(state) < 2:
        yield f"{len(state)} frames; a transition needs two"


def _action_faults(action: np.ndarray | None, state: np.ndarray | None, wide: int) -> Iterator[str]:
    if action is None:
        return
    infinite = np.isinf(action).any(-1)
    if action.shape[1] != wide:
        yield f"actions have {action.shape[1]} columns, those before have {wide}"
    elif state is not None and len(action) not in (len(state) - 1, len(state)):
        wanted = f"wanted one per frame ({len(state)}) or one per transition ({len(state) - 1})"
        yield f"{len(action)} actions for {len(state)} frames; {wanted}"
    elif infinite.any():
        yield f"the action of step {infinite.argmax()} is infinite; mark unknown actions by NaN"


def wrong_rate(value: Any, name: str) -> list[str]:
    """Returns a list with a message if a rate is no positive number, else an empty list."""
    real = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, bool)
    if real and 0 < value < math.inf:
        return []
    return [f"{option(name)} must be a positive number of frames per second, got {value!r}"]


def resolves_coarsely(low: np.ndarray, high: np.ndarray, dtype: type[np.floating]) -> np.ndarray:
    """Returns which columns, from ``low`` to ``high`` ``[d]``, a dtype rounds by more than 1e-5 of their range."""
    with np.errstate(over="ignore", invalid="ignore"):
        rounding = np.spacing(np.maximum(np.abs(low), np.abs(high)).astype(dtype))
        return (high > low) & ~(rounding <= _COARSE * (high - low))


def one_each(given: Any, wide: int, what: str, problems: list[str]) -> tuple[Any, ...]:
    """Returns an option's value for each column, given once or per column; adds a problem if the number differs."""
    said = (given,) * wide if isinstance(given, str) else tuple(given)
    if len(said) != wide:
        problems.append(f"{option(what)} names {len(said)} columns, there are {wide}")
    return said


def _listed(values: Any, what: str, wanted: str, source: str) -> list[Any]:
    one = values.ndim == 2 if isinstance(values, (np.ndarray, torch.Tensor)) else isinstance(values, _DataFrame)
    if one:  # list(frame) would be its column names
        raise DataError(source, f"{what} must be a list of recordings {wanted}, got one array {list(values.shape)}")
    with contextlib.suppress(TypeError, RuntimeError):  # not a sequence; nested tensors
        if not isinstance(values, (str, Path, Mapping)):
            return list(values)
    kind, cure = type(values).__name__, "files are read by read_recordings (`koap convert`)"
    if isinstance(values, Mapping):
        cure = "give the arrays of its entries as lists, in the arguments states and actions"
    raise DataError(source, f"{what} must be a sequence of arrays {wanted}, one per trajectory, got {kind}: {cure}")


def _by_name(
    tables: list[Any], names: Sequence[str] | None, what: str, labels: Sequence[str], faults: list[tuple[str, str]]
) -> tuple[list[Any], Sequence[str] | None]:
    """Orders the columns of data frames as in ``names`` or the first; other column names are faults."""
    heads = [list(table.columns) if isinstance(table, _DataFrame) else [] for table in tables]
    order = next(filter(None, heads), [])
    if not all(isinstance(name, str) for name in order):  # pandas numbers columns without names
        return tables, names
    for label, head in zip(labels, heads, strict=True):
        if head and (odd := set(head) ^ set(order)):
            faults.append((label, f"columns of {what} differ from those before by {some(sorted(map(str, odd)))}"))
    order = list(names) if names is not None and set(names) == set(order) else order
    ordered = [
        table[order] if head and set(head) == set(order) else table for table, head in zip(tables, heads, strict=True)
    ]
    return ordered, order or None if names is None else names


def _table(value: Any, what: str, wanted: str, name: str, faults: list[tuple[str, str]]) -> np.ndarray | None:
    """Converts a trajectory to float64, NaN where it is masked or None; adds a fault and returns None on failure."""
    try:
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu()
            value = (value.double() if value.is_floating_point() else value).numpy()
        array = np.ma.asarray(value)
        if array.dtype.kind in "fiubO":
            array = array.astype(np.float64).filled(np.nan)
    except (ValueError, TypeError, RuntimeError):  # ragged lists; other objects; sparse tensors
        said = f"{what} are no table of numbers {wanted}, got {type(value).__name__}"
        if isinstance(value, (list, tuple)) and len(widths := sorted({np.size(row) for row in value})) > 1:
            said = f"{what} are lists of different lengths: rows of {' and '.join(map(str, widths))} numbers"
        faults.append((name, said))
        return None
    if what == "actions" and array.shape[:1] == (0,):  # none were recorded
        return None
    if array.ndim != 2 or not array.shape[-1]:
        faults.append((name, f"{what} must be {wanted}, got {list(array.shape)}"))
    elif array.dtype.kind != "f":
        faults.append((name, f"{what} are {array.dtype}, wanted numbers in the unit that the robot reports"))
    else:
        return array
    return None


def _sparse(actions: Sequence[np.ndarray], names: Sequence[str]) -> list[str]:
    """Reports action columns that are known in less than half as many steps as another one."""
    known = np.isfinite(np.concatenate(actions)).sum(0) if actions else np.zeros(0, dtype=int)
    sparse = [
        f"{name!r} (known in {count})" for name, count in zip(names, known, strict=False) if 2 * count < known.max()
    ]
    if not sparse:
        return []
    return [
        f"{known.max()} steps have actions, but action column {', '.join(sparse)} is mostly empty; a label needs all"
        " columns: repeat its last value where it still applies, or drop it with"
        f" {option('drop_columns')}"
    ]


def _names(given: Sequence[str] | None, width: int, kind: str, problems: list[str]) -> tuple[str, ...]:
    if given is None:
        return tuple(f"{kind}_{index}" for index in range(width))
    if isinstance(given, str):
        problems.append(f"{kind}_names must be a list of {width} names, got the text {given!r}")
    names = tuple(str(name) for name in given)
    if not all(name.strip() for name in names):
        problems.append(f"{kind}_names holds an empty name")
    if len(names) != width:
        problems.append(f"{kind}_names has {len(names)} names for {width} columns")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        problems.append(f"{kind}_names holds {', '.join(repeated)} more than once")
    return names
