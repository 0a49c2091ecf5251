# This source code is licensed under the MIT license found in the LICENSE file.
"""From named columns to recordings, for every reader: what is a state, where episodes end, the rate of the frames."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from torchrl_koap.data.formats.recordings import Recordings, make_recordings
from torchrl_koap.data.formats.resampling import UNEVEN, resampled
from torchrl_koap.files import DataError, some
from torchrl_koap.lookup import lookup

# what columns are called that are no state, in lower case, without unit
KINDS = {
    "clock": "timestamp timestamps time times t stamp stamps clock",
    "episode": "episode episodes episode_index episode_id episode_number trajectory trajectory_index trajectory_id"
    " traj traj_id demo demo_id",
    "end": "timeout timeouts terminal terminals termination terminations truncation truncations truncated terminated"
    " done dones episode_end episode_ends is_last is_terminal",
    "frame": "frame frames frame_index frame_id step",
    "other": "index task_index row __index_level_0__ unnamed:_0 reward rewards return returns success is_success"
    " is_first",
}
_KIND = {name: kind for kind, names in KINDS.items() for name in names.split()}
_UNITS = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_UNIT = re.compile(rf"(.+?)[ _.-]*[ _.(\[-]({'|'.join(_UNITS)})[)\]]?")
SLOWEST, FASTEST = 1.0, 2000.0  # Hz; beyond, stamps are in another unit
_LONG = 20  # frames after which a column that rises evenly is taken for a clock


@dataclass(frozen=True)
class Piece:
    """What a reader found in one file, demonstration or episode.

    Args:
        name (str): what messages call it.
        states (dict): columns ``[T]`` of everything that is no action, by name.
        actions (dict, optional): columns ``[T]`` or ``[T - 1]`` of actions, by name; None where there are none.
        unclear (tuple of str): columns among the states of which the user has to say what they are.
    """

    name: str
    states: dict[str, np.ndarray]
    actions: dict[str, np.ndarray] | None = None
    unclear: tuple[str, ...] = ()


def spread(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Columns of a table ``[T]`` or ``[T, d]``, numbered if there are several."""
    table = np.asarray(values).reshape(len(values), -1)
    alone = table.shape[1] == 1
    return {name if alone else f"{name}_{index}": table[:, index] for index in range(table.shape[1])}


def kind_of(name: str) -> tuple[str | None, float]:
    """What a column is by its name, None for a state; and of a clock its unit in seconds, 0.001 of "Time [ms]"."""
    plain = name.strip().lower().removeprefix("next.")
    unit = _UNIT.fullmatch(plain)
    base, scale = (unit[1], _UNITS[unit[2]]) if unit else (plain, 1.0)
    kind = _KIND.get(re.sub(r"[\s-]+", "_", base))
    return (kind, scale if kind == "clock" else 1.0)


def assemble(
    pieces: Sequence[Piece],
    source: str,
    *,
    declared_hz: float | None = None,
    control_hz: float | None = None,
    resample: float | None = None,
    action_kind: str | Sequence[str] = "delta",
    state_columns: Sequence[str] = (),
    drop_columns: Sequence[str] = (),
    action_dim: int | None = None,
    action_names: Sequence[str] | None = None,
    skipped: Sequence[str] = (),
    no_rate: str = "no file has time stamps (a column 'timestamp' in seconds): pass control_hz",
) -> Recordings:
    """Splits episodes, leaves out what is no state, reads the rate off the time stamps, and checks what is left.

    Args:
        pieces (sequence of Piece): what was found, in order.
        source (str): what messages call the whole.

    Keyword Args:
        declared_hz (float, optional): frames per second that the source declares; time stamps must agree.
        control_hz, resample, action_kind, state_columns, drop_columns, action_dim: as for
            :func:`~torchrl_koap.data.read_recordings`.
        action_names (sequence of str, optional): names of the action columns, where nothing has actions.
        skipped (sequence of str): entries that the reader left out.
        no_rate (str): what is said where nothing tells the rate.

    Raises:
        DataError: with all faults.
    """
    if not pieces:
        raise DataError(source, "there are no trajectories")
    problems = [*_other_names(pieces), *_other_lengths(pieces)]
    if problems:
        raise DataError(source, problems)
    pieces = [part for piece in pieces for part in _episodes(piece, problems)]
    names = list(pieces[0].states)
    acting = next((list(piece.actions) for piece in pieces if piece.actions is not None), [])
    problems += unknown(state_columns, names, "column in state_columns:")
    problems += unknown(drop_columns, [*names, *acting], "column in drop_columns:")
    problems += [
        f"{name!r} has a number for every frame: does it say which episode a frame is of, or where episodes end? call"
        " it episode_index or timeouts then; else name the state's columns in state_columns, or drop it in drop_columns"
        for name in dict.fromkeys(name for piece in pieces for name in piece.unclear)
        if name not in drop_columns and not state_columns
    ]
    even = set() if state_columns else _even(pieces)
    usable = [name for name in names if kind_of(name)[0] is None and name not in even]
    observed = [name for name in state_columns or usable if name not in drop_columns]
    unused = [name for name in names if name not in observed]
    left_out = [*skipped, *(f"{name} (it rises evenly: a clock)" if name in even else name for name in unused)]
    if not observed:
        problems.append(f"{pieces[0].name}: has no state columns, only {', '.join([*acting, *names])}")
    left_out += [name for name in acting if name in drop_columns]
    acting = [name for name in acting if name not in drop_columns]
    rate, times = control_hz, None
    if control_hz is None:
        rate, times = _find_rate(pieces, declared_hz, no_rate, resample is None, problems)
    if problems:
        raise DataError(source, problems)
    recordings = make_recordings(
        [_stack(piece.states, observed) for piece in pieces],
        [_stack(piece.actions, acting) if piece.actions and acting else None for piece in pieces],
        action_dim=action_dim,
        state_names=observed,
        action_names=acting or action_names,
        sources=[piece.name for piece in pieces],
        control_hz=rate,
        skipped=left_out,
        source=source,
    )
    return recordings if resample is None else resampled(recordings, resample, action_kind, times=times)


def unknown(asked: Sequence[str], known: Sequence[str], what: str) -> list[str]:
    """What is to be said of names that are none of those known."""
    said = []
    for name in asked:
        try:
            lookup(known, name, what)
        except ValueError as error:
            said.append(str(error))
    return said


def _stack(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    return np.stack([columns[name] for name in names], 1).astype(np.float64)


def _find_rate(
    pieces: Sequence[Piece], declared: float | None, otherwise: str, fixed: bool, problems: list[str]
) -> tuple[float | None, list[np.ndarray] | None]:
    """Frames per second by the time stamps of all pieces, and these in seconds; what is declared where there are none.

    Stamps that are to be ``fixed`` have even steps, and agree with what is declared.
    """
    clock = next((name for name in pieces[0].states if kind_of(name)[0] == "clock"), None)
    if clock is None:
        if declared is None:
            problems.append(otherwise)
        return declared, None
    stamps = [piece.states[clock].astype(np.float64) for piece in pieces]
    times = [(values - values[:1]) * kind_of(clock)[1] for values in stamps]
    steps = [np.diff(values) for values in times]
    back = [piece.name for piece, step in zip(pieces, steps, strict=True) if not (step > 0).all()]
    if back or not sum(map(len, steps)):
        where = f" in {len(back)} of {len(steps)} trajectories ({some(back)})" if back else ""
        problems.append(f"time stamps do not increase: column {clock!r}{where}; pass control_hz if they mean nothing")
        return None, None
    usual = float(np.median(np.concatenate(steps)))
    if not SLOWEST <= 1 / usual <= FASTEST:
        problems.append(
            f"column {clock!r} says {1 / usual:.3g} frames per second if it is in seconds: name it {clock}_ms,"
            f" {clock}_us or {clock}_ns if it is in another unit, or pass control_hz"
        )
        return None, None
    if not fixed:
        return 1 / usual, times
    uneven = [
        f"{piece.name}: frames are {step.min():.4g} to {step.max():.4g} s apart (frame {np.abs(step - usual).argmax()})"
        for piece, step in zip(pieces, steps, strict=True)
        if np.abs(step - usual).max(initial=0) > UNEVEN * usual
    ]
    if uneven:
        problems.append(
            f"{some(uneven)}; the usual step is {usual:.4g} s: pass resample {1 / usual:.3g} (Hz) to bring them to a"
            " fixed rate, or control_hz if the stamps are wrong"
        )
    if declared is not None and abs(declared * usual - 1) > UNEVEN:
        problems.append(
            f"column {clock!r} says {1 / usual:.4g} frames per second, the source declares {declared:g}:"
            " pass control_hz"
        )
    return float(1 / usual) if declared is None else declared, times


def _episodes(piece: Piece, problems: list[str]) -> list[Piece]:
    """The episodes of a piece; the piece itself if it is one, or if nothing separates them."""
    try:
        order, begins = _order(piece)
    except ValueError as error:
        problems.append(f"{piece.name}: {error}")
        return [piece]
    starts, length = np.flatnonzero(begins), len(order)
    if len(starts) < 2 and np.array_equal(order, np.arange(length)):
        return [piece]
    if piece.actions is not None and any(len(values) != length for values in piece.actions.values()):
        problems.append(
            f"{piece.name}: it holds {len(starts)} episodes, so an action beside each of its {length} frames"
        )
        return [piece]
    spans = [order[start:end] for start, end in zip(starts, [*starts[1:], length], strict=True)]
    names = [piece.name] if len(spans) == 1 else [f"{piece.name}[{index}]" for index in range(len(spans))]
    return [
        replace(piece, name=name, states=_cut(piece.states, span), actions=piece.actions and _cut(piece.actions, span))
        for name, span in zip(names, spans, strict=True)
    ]


def _cut(columns: Mapping[str, np.ndarray], span: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[span] for name, values in columns.items()}


def _order(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """The order of the rows of a piece, and which of them, so ordered, begin an episode.

    Told by the number of the episode, by a frame counter that starts again, or by flags of the ends.
    """
    rows = np.arange(len(next(iter(piece.states.values()), ())))
    called = {kind_of(name)[0]: name for name in reversed(piece.states)}
    columns = {kind: piece.states[name] for kind, name in called.items()}
    number, frame = columns.get("episode"), columns.get("frame")
    if number is not None:
        sorting = columns.get("clock") if frame is None else frame
        starts = _changes(number)
        sorted_by = number[:, None] if sorting is None else np.stack([number, sorting], 1)
        if starts.sum() > len(np.unique(number)) and len(np.unique(sorted_by, axis=0)) < len(rows):
            again = next(value for value in number[starts] if (number[starts] == value).sum() > 1)
            raise ValueError(
                f"{called['episode']} {again:g} comes back after another one, and no frame index or time says how its"
                " rows follow each other"
            )
        order = rows if sorting is None else np.lexsort((sorting, number))
        return order, _changes(number[order])
    if frame is not None and (np.diff(frame) <= 0).any():
        if len(np.unique(frame)) == len(rows):  # one episode, out of order
            return np.argsort(frame), rows == 0
        starts = np.r_[True, np.diff(frame) < 0]
        if not (frame[starts] == frame[0]).all() or (np.diff(frame) == 0).any():
            raise ValueError(
                f"column {called['frame']!r} neither counts on nor starts again: a column 'episode' says which rows"
                " belong together"
            )
        return rows, starts
    starts = rows == 0
    for flag in (values for name, values in piece.states.items() if kind_of(name)[0] == "end"):
        if set(np.unique(flag)) - {0, 1}:
            raise ValueError("columns of the ends of episodes must be 0 or 1")
        starts = starts | np.r_[False, (flag[:-1] > 0) & (flag[1:] == 0)]  # an episode ends where a flag falls
    return rows, starts


def _changes(numbers: np.ndarray) -> np.ndarray:
    return np.r_[True, numbers[1:] != numbers[:-1]]


def _even(pieces: Sequence[Piece]) -> set[str]:
    """State columns that rise by the same amount in every frame of all pieces; none if that would be all."""
    found = set()
    states = [name for name in pieces[0].states if kind_of(name)[0] is None]
    for name in states:
        steps = np.concatenate([np.diff(piece.states[name].astype(np.float64)) for piece in pieces])
        first = steps[0] if len(steps) >= _LONG else 0.0
        if first > 0 and np.allclose(steps, first, rtol=1e-6, atol=0):
            found.add(name)
    return found if len(found) < len(states) else set()


def _other_names(pieces: Sequence[Piece]) -> Iterator[str]:
    for kind in ("state", "action"):
        named = [(piece.name, piece.states if kind == "state" else piece.actions) for piece in pieces]
        found = [(name, list(columns)) for name, columns in named if columns is not None]
        for name, columns in found:
            if columns != found[0][1]:
                first, wanted = found[0][0], ", ".join(found[0][1])
                yield f"{name}: {kind} columns are {', '.join(columns)}; those of {first} are {wanted}"


def _other_lengths(pieces: Sequence[Piece]) -> Iterator[str]:
    for piece in pieces:
        for columns in (piece.states, piece.actions or {}):
            if len({len(values) for values in columns.values()}) > 1:
                shapes = ", ".join(f"{name} {len(values)}" for name, values in columns.items())
                yield f"{piece.name}: its columns have different numbers of rows: {shapes}"
