# This source code is licensed under the MIT license found in the LICENSE file.
"""Splits tables into episodes by their number, a counter or clock that restarts, and flags of starts and ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from torchrl_koap.data.formats.clocks import UNEVEN, clocks_of, rises_evenly
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.kinds import kind_of
from torchrl_koap.files import option

SHUFFLED = 0.25  # rows are out of order if their clock goes back, or the next row is another, in more than this share
NEXT_END = "next.done"  # flags the last frames of episodes that next observations show
_SAME, _ROUNDED = 1e-3, 1e-6  # rounding errors: share of a column's range, and of its largest number


@dataclass(frozen=True)
class Piece:
    """Content of one file, demonstration or episode, as a reader found it."""

    name: str  # for messages
    states: dict[str, np.ndarray]  # columns [T], all but the actions
    actions: dict[str, np.ndarray] | None = None  # columns [T] or [T - 1]; None if there are none
    unclear: tuple[str, ...] = ()  # columns of ``states`` whose meaning the user must state
    cameras: dict[str, Clip] = field(default_factory=dict)  # location of the frames, one per row
    declared_hz: float | None = None  # frames per second, if the source declares it
    unread: tuple[str, ...] = ()  # parts that were left out

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(next(iter(self.states.values()), ()))

    @property
    def clocks(self) -> dict[str, np.ndarray]:
        """Columns of time stamps, in seconds."""
        kinds = {name: kind_of(name) for name in self.states}
        return {name: self.states[name] * unit for name, (kind, unit) in kinds.items() if kind == "clock"}

    def taken(self, rows: np.ndarray) -> Piece:
        """Selects frames and keeps all actions."""
        cameras = {name: clip.take(rows) for name, clip in self.cameras.items()}
        return replace(self, states=_cut(self.states, rows), cameras=cameras)

    def of_kind(self, kind: str) -> dict[str, np.ndarray]:
        """Returns the columns of a kind (:func:`~torchrl_koap.data.formats.kinds.kind_of`)."""
        return {name: values for name, values in self.states.items() if kind_of(name)[0] == kind}


def split_episodes(piece: Piece, problems: list[str]) -> list[Piece]:
    """Splits a piece into episodes; returns the piece itself if it has one, or if a problem was added."""
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
            f"{piece.name}: it holds {len(starts)} episodes and {len(next(iter(piece.actions.values())))} actions for"
            f" {length} frames: with several episodes, every frame needs an action"
        )
        return [piece]
    spans = [order[start:end] for start, end in zip(starts, [*starts[1:], length], strict=True)]
    names = [piece.name] if len(spans) == 1 else [f"{piece.name}[{index}]" for index in range(len(spans))]
    return [
        replace(piece.taken(span), name=name, actions=piece.actions and _cut(piece.actions, span))
        for name, span in zip(names, spans, strict=True)
    ]


def _cut(columns: Mapping[str, np.ndarray], span: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[span] for name, values in columns.items()}


def _order(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Returns the order of the rows of a piece, and which of the ordered rows begin an episode.

    Rows of one episode number belong together. Among them a frame counter, or else a clock, splits episodes where it
    restarts, and sorts rows that are out of order. Flags of starts and ends split them, too.
    """
    parts = _numbered(piece)
    counters, clocks = piece.of_kind("frame"), clocks_of([piece.clocks], [piece.name])
    if counters:
        name, frame = next(iter(counters.items()))
        found = [_by_counter(name, frame[rows]) for rows in parts]
    elif clocks:
        found = _by_clock([clocks[0].times[0][rows] for rows in parts])
    else:
        found = [(np.arange(len(rows)), _first(rows)) for rows in parts]
    order = np.concatenate([rows[inner] for rows, (inner, _) in zip(parts, found, strict=True)])
    return order, np.concatenate([starts for _, starts in found]) | _flagged(piece, order)


def _numbered(piece: Piece) -> list[np.ndarray]:
    """Returns the rows of every episode number, or all rows if there are no numbers.

    Raises:
        ValueError: if a number is missing, or returns without a counter or clock that orders its rows.
    """
    numbers = piece.of_kind("episode")
    if not numbers:
        return [np.arange(piece.frames)]
    for name, values in numbers.items():
        if np.isnan(values).any():
            raise ValueError(f"column {name!r} is empty in row {int(np.isnan(values).argmax())}")
    number = np.unique(np.stack(list(numbers.values())), axis=1, return_inverse=True)[1].reshape(-1)
    rows = np.argsort(number, kind="stable")
    parts = np.split(rows, np.flatnonzero(np.diff(number[rows])) + 1)
    again = next((part[1:][np.diff(part) > 1][0] for part in parts if (np.diff(part) > 1).any()), None)
    if again is not None and not piece.of_kind("frame") and not piece.clocks:
        said = " of ".join(f"{name} {values[again]:g}" for name, values in numbers.items())
        raise ValueError(f"{said} returns after another one, and no frame index or time gives the order of its rows")
    return parts


def _by_counter(name: str, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the order of rows by a frame counter ``[T]``, and which of the ordered rows begin an episode."""
    if len(np.unique(frame)) == len(frame):
        return np.argsort(frame), _first(frame)
    starts = np.r_[True, np.diff(frame) < 0]
    if not (frame[starts] == frame[0]).all():
        back = starts.nonzero()[0][frame[starts] != frame[0]][0]
        raise ValueError(
            f"column {name!r} goes back from {frame[back - 1]:g} to {frame[back]:g}, not to its first number: end an"
            f" episode there (a column 'episode_index'), or drop the counter with {option('drop_columns')}"
        )
    return np.arange(len(frame)), starts


def _by_clock(parts: Sequence[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Returns the order of rows by a clock ``[T]``, and which of the ordered rows begin an episode, for all parts.

    A few steps back that are no restart are faults of the clock, not rows out of order.
    """
    starts = [_restarts(times) for times in parts]
    whole = [begins.sum() == 1 for begins in starts]
    order = [np.argsort(at, kind="stable") if one else np.arange(len(at)) for at, one in zip(parts, whole, strict=True)]
    back = sum(int((np.diff(at) < 0).sum()) for at, one in zip(parts, whole, strict=True) if one)
    ordered = [at[rows] for at, rows, one in zip(parts, order, whole, strict=True) if one]
    shuffled = back > SHUFFLED * sum(map(len, ordered)) or back and rises_evenly(ordered, room=UNEVEN, least=1)
    if not shuffled:
        order = [np.arange(len(at)) for at in parts]
    return list(zip(order, starts, strict=True))


def _restarts(times: np.ndarray) -> np.ndarray:
    """Returns in which rows of a clock ``[T]`` an episode begins: the first, and those where all begin again.

    A clock begins again if it goes back to its first time and runs on from there. A single wrong stamp does not.
    """
    if len(times) < 2:
        return _first(times)
    back, steps = np.r_[True, np.diff(times) < 0], np.diff(times, append=times[-1])
    usual = np.median(np.abs(steps[:-1]))
    again = (np.abs(times[back] - times[0]) < usual / 2) & (steps[back] > 0) & (steps[back] < 2 * usual)
    return back if again.all() else _first(times)


def _first(rows: np.ndarray) -> np.ndarray:
    return np.arange(len(rows)) == 0


def _flagged(piece: Piece, order: np.ndarray) -> np.ndarray:
    """Returns which of the ordered rows begin an episode by flags of starts and ends; the first one always does.

    Flags may stay 1 for several rows.
    """
    starts = _first(order)
    for name, values in piece.states.items():
        kind, flag = kind_of(name)[0], values[order]
        switch = not set(np.unique(flag)) - {0, 1}
        if kind in ("start", "end") and not switch:
            raise ValueError(
                f"column {name!r} of the {kind}s of episodes must be 0 or 1: rename it if it is something else, or drop"
                f" it with {option('drop_columns')}"
            )
        if kind == "start":
            starts = starts | np.r_[False, (flag[:-1] == 0) & (flag[1:] > 0)]
        elif kind == "end" or kind == "length" and switch:
            starts = starts | np.r_[False, (flag[:-1] > 0) & (flag[1:] == 0)]
    return starts


def other_frames(frames: np.ndarray, following: np.ndarray) -> np.ndarray:
    """Returns which rows of the next observations ``[T, d]`` are not the next frame, bool ``[T - 1]``."""
    frames, following = (part.reshape(len(part), -1).astype(np.float64) for part in (frames, following))
    room = _SAME * np.ptp(frames, axis=0) + _ROUNDED * np.abs(frames).max() if len(frames) > 1 else 0.0
    return (np.abs(following[:-1] - frames[1:]) > room).any(-1)


def with_last_frames(piece: Piece, following: np.ndarray, key: str) -> Piece:
    """Adds the last frame of every episode, to which its last action leads, from the next observations ``[T, d]``.

    They are those of the first d columns, called ``key``. An episode ends where they are not the next row.

    Raises:
        ValueError: if they are not in so many rows that the rows are shuffled.
    """
    names, length = list(piece.states)[: following.shape[1]], piece.frames
    off = other_frames(np.stack([piece.states[name] for name in names], 1), following)
    if off.sum() > SHUFFLED * length:
        raise ValueError(
            f"next_{key} is not the next row of {key} in {off.sum()} of {length} rows: sort the rows, as shuffled"
            f" ones hold no motion, or leave out next_{key} if it is unused"
        )
    steps = piece.actions or {}
    whole = all(len(values) == length for values in steps.values())  # else there are T - 1 actions for T frames
    ends = np.flatnonzero(np.append(off, whole) & np.isfinite(following).all(1))
    places = ends + np.arange(1, len(ends) + 1)  # of the added frames
    found = replace(piece, states=piece.states | {NEXT_END: np.append(off, False).astype(np.float64)})
    found = found.taken(np.sort(np.r_[np.arange(length), ends]))
    found.states[NEXT_END][places - 1] = 0
    for name, values in found.states.items():
        if name in names:
            values[places] = following[ends, names.index(name)]
        elif kind_of(name)[0] in ("clock", "frame"):
            values[places] += np.median(np.diff(piece.states[name]))
    return replace(found, actions={name: np.insert(values, ends + 1, np.nan) for name, values in steps.items()} or None)


def counted_ends(values: np.ndarray, length: int, kind: str | None) -> np.ndarray | None:
    """Converts lengths, ends or starts of episodes, by the kind of an entry, to flags ``[length]`` of last frames.

    An entry without kind is converted if its numbers could be any of these; returns None if they could not.
    """
    if values.ndim != 1 or values.dtype.kind not in "iu" or not 0 < len(values) < length:
        return None
    rises = bool((np.diff(values.astype(np.int64)) > 0).all())
    if kind in ("end", None) and rises and values[-1] in (length, length - 1):
        last = values - (values[-1] == length)
    elif kind in ("length", None) and values.sum() == length and values.all():
        last = values.cumsum() - 1
    elif kind in ("start", None) and rises and values[0] == 0:
        last = np.append(values[1:], length) - 1
    else:
        return None
    return np.isin(np.arange(length), last).astype(np.float64)
