# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts named columns to recordings, for all readers: selects states, splits episodes, finds the frame rate."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from torchrl_koap.data.formats.clocks import NOT_READ, UNEVEN, clocks_of, find_rate, rises_evenly, told_rate, usual_rate
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.kinds import kind_of
from torchrl_koap.data.formats.recordings import Recordings, make_recordings
from torchrl_koap.data.formats.resampling import resampled
from torchrl_koap.files import DataError, gathered, option, refuse, some
from torchrl_koap.lookup import unknown

SHUFFLED = 0.25  # rows are out of order if their clock goes back in more than this share of them


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
    no_rate: str = "no file has time stamps (a column 'timestamp' in seconds, or dates such as 2024-03-31 12:30:05.1)",
) -> Recordings:
    """Splits episodes, leaves out columns that are no state, finds the rate from time stamps, and checks the rest.

    Options are those of :func:`~torchrl_koap.data.read_recordings`. From the reader come ``source``, the name in
    messages; ``declared_hz``, with which time stamps must agree; ``action_names``, used if no piece has actions;
    ``skipped``, what the reader left out; and ``no_rate``, the message if the rate is unknown.
    """
    if not pieces:
        raise DataError(source, "there are no trajectories")
    seen = dict.fromkeys(name for piece in pieces for name in piece.states)
    skipped = [*(name for piece in pieces for name in piece.unread), *skipped]
    every = dict.fromkeys(name for piece in pieces for name in (*piece.states, *(piece.actions or ()), *piece.cameras))
    problems = unknown(state_columns, [*seen], f"column in {option('state_columns')}:")
    problems += unknown(drop_columns, [*every], f"column in {option('drop_columns')}:")
    used = {name for name in seen if not state_columns or name in state_columns or kind_of(name)[0] is not None}
    pieces = [
        replace(
            piece,
            states={name: values for name, values in piece.states.items() if name in used - {*drop_columns}},
            actions=_without(piece.actions or {}, drop_columns) or None,
            cameras=_without(piece.cameras, drop_columns),
        )
        for piece in pieces
    ]
    refuse(source, problems + gathered([*_other_names(pieces), *_other_lengths(pieces)]))
    refuse(source, list(_camera_faults(pieces)))
    parts = [part for piece in pieces for part in _episodes(piece, problems)]
    short = [f"{part.name} (fewer than two frames)" for part in parts if part.frames < 2]
    pieces = [part for part in parts if part.frames > 1]
    if not pieces:
        raise DataError(source, problems or [f"none of its {len(parts)} trajectories has two frames"])
    names = list(pieces[0].states)
    acting = next((list(piece.actions) for piece in pieces if piece.actions is not None), [])
    unclear = dict.fromkeys(name for piece in pieces for name in piece.unclear if name not in drop_columns)
    if unclear and not state_columns:
        problems.append(
            f"{', '.join(map(repr, unclear))} may be the episode of each frame, or the ends of episodes: if so, name it"
            " episode_index, timeouts or episode_ends; if it is a column of the states or the actions, store it there;"
            f" otherwise name the state's columns in {option('state_columns')}, or drop it with"
            f" {option('drop_columns')}"
        )
    even = set() if state_columns else _even(pieces)
    usable = [name for name in names if kind_of(name)[0] is None and name not in even]
    observed = [name for name in state_columns or usable if name not in drop_columns]
    about = dict.fromkeys(even, " (it rises evenly: a clock)")
    clocks, rate = clocks_of([piece.clocks for piece in pieces], [piece.name for piece in pieces]), control_hz
    counting = clocks.pop(0) if clocks and control_hz is None else None
    if counting is not None:
        rate = find_rate(counting, declared_hz, problems) if resample is None else usual_rate(counting, problems)
    else:
        problems += gathered(_lost_frames(pieces))
        rate = declared_hz if rate is None else rate
        problems += [f"{no_rate}: pass {option('control_hz')}"] if rate is None else []
    about |= {clock.name: told_rate(clock, rate) for clock in clocks if rate is not None}
    if clocks and control_hz is not None and (against := about[clocks[0].name]) not in ("", NOT_READ):
        warnings.warn(
            f"column {clocks[0].name!r}{against} is overridden by {option('control_hz')} {control_hz:g}: if its stamps"
            f" are right, pass only {option('resample')} {resample or control_hz:g}",
            stacklevel=2,
        )
    for name in (name for name in seen if "success" in name.lower() and kind_of(name)[0] == "other"):
        failed = sum(not piece.states[name].any() for piece in pieces if name in piece.states)
        about |= {name: f" (0 throughout {failed} trajectories, which are kept)"} if failed else {}
    left_out = [*skipped, *short, *(name + about.get(name, "") for name in seen if name not in observed)]
    left_out += [name for name in drop_columns if name not in left_out]
    if not observed:
        problems.append(f"{pieces[0].name}: has no state columns, only {', '.join([*acting, *names])}")
    refuse(source, problems)
    times = None
    if resample is not None:
        pieces = [piece if _labelled(piece) else replace(piece, actions=None) for piece in pieces]
        times = [np.arange(piece.frames) / rate for piece in pieces] if counting is None else counting.times
        seen_in = [np.isfinite(_stack(piece.states, observed)).all(1) | bool(piece.actions) for piece in pieces]
        times = [at[rows] for at, rows in zip(times, seen_in, strict=True)]
        pieces = [_taken(piece, np.flatnonzero(rows)) for piece, rows in zip(pieces, seen_in, strict=True)]
        lost = sum(int((~rows).sum()) for rows in seen_in)
        left_out += [f"{lost} frames with states that are NaN"] if lost else []
    recordings = make_recordings(
        [_stack(piece.states, observed) for piece in pieces],
        [_stack(piece.actions, acting) if piece.actions else None for piece in pieces],
        action_dim=action_dim,
        state_names=observed,
        action_names=acting or action_names,
        sources=[piece.name for piece in pieces],
        control_hz=rate,
        skipped=left_out,
        cameras={name: [piece.cameras[name] for piece in pieces] for name in pieces[0].cameras},
        source=source,
    )
    return recordings if resample is None else resampled(recordings, resample, action_kind, times=times)


def _labelled(piece: Piece) -> bool:
    return any(np.isfinite(values).any() for values in (piece.actions or {}).values())


def _without(columns: Mapping[str, Any], dropped: Sequence[str]) -> dict[str, Any]:
    return {name: values for name, values in columns.items() if name not in dropped}


def _stack(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    return np.stack([columns[name] for name in names], 1).astype(np.float64)


def _lost_frames(pieces: Sequence[Piece]) -> Iterator[tuple[str, str]]:
    """Finds pieces whose frame counter skips numbers; used where no clock shows lost frames."""
    for piece in pieces:
        for name in [name for name in piece.states if kind_of(name)[0] == "frame"]:
            steps = np.diff(piece.states[name])
            lost = np.flatnonzero(steps != np.median(steps))
            if len(lost):
                before, after = piece.states[name][lost[0] : lost[0] + 2]
                yield (
                    piece.name,
                    f"column {name!r} goes from {before:g} to {after:g}: add the missing frames, end an episode there"
                    f" (a column 'episode_index'), or drop the counter with {option('drop_columns')}",
                )


def _episodes(piece: Piece, problems: list[str]) -> list[Piece]:
    """Splits a piece into episodes; returns the piece itself if it has one episode."""
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
        replace(_taken(piece, span), name=name, actions=piece.actions and _cut(piece.actions, span))
        for name, span in zip(names, spans, strict=True)
    ]


def _taken(piece: Piece, rows: np.ndarray) -> Piece:
    """Selects frames of a piece and keeps all of its actions."""
    cameras = {name: clip.take(rows) for name, clip in piece.cameras.items()}
    return replace(piece, states=_cut(piece.states, rows), cameras=cameras)


def _cut(columns: Mapping[str, np.ndarray], span: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[span] for name, values in columns.items()}


def _order(piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Returns the order of the rows of a piece, and which of the ordered rows begin an episode.

    Episodes are found by their number, by a frame counter or clock that restarts, and by flags of starts and ends. Rows
    of an episode that are out of order are sorted by its counter or clock.
    """
    rows = np.arange(piece.frames)
    counter = next((name for name in piece.states if kind_of(name)[0] == "frame"), "")
    clocks = clocks_of([piece.clocks], [piece.name])
    frame, clock = piece.states.get(counter), clocks[0].times[0] if clocks else None
    numbers = {name: values for name, values in piece.states.items() if kind_of(name)[0] == "episode"}
    for name, values in numbers.items():
        if np.isnan(values).any():
            raise ValueError(f"column {name!r} is empty in row {int(np.isnan(values).argmax())}")
    if numbers:
        number = np.unique(np.stack(list(numbers.values())), axis=1, return_inverse=True)[1].reshape(-1)
        sorting = clock if frame is None else frame
        starts = _changes(number)
        sorted_by = number[:, None] if sorting is None else np.stack([number, sorting], 1)
        if starts.sum() > len(np.unique(number)) and len(np.unique(sorted_by, axis=0)) < len(rows):
            again = next(at for at in np.flatnonzero(starts) if (number[starts] == number[at]).sum() > 1)
            said = " of ".join(f"{name} {values[again]:g}" for name, values in numbers.items())
            raise ValueError(
                f"{said} returns after another one, and no frame index or time gives the order of its rows"
            )
        order = rows if sorting is None else np.lexsort((sorting, number))
        if frame is None and clock is not None:  # a few steps back are faults of the clock, not rows out of order
            kept = np.argsort(number, kind="stable")
            begins = np.flatnonzero(_changes(number[kept]))[1:]
            back = sum(int((np.diff(part) < 0).sum()) for part in np.split(clock[kept], begins))
            even = rises_evenly(np.split(clock[order], begins), room=UNEVEN, least=1)
            order = order if even or back > SHUFFLED * len(rows) else kept
        return order, _changes(number[order]) | _flagged(piece, order)
    if frame is not None and (np.diff(frame) <= 0).any():
        if len(np.unique(frame)) == len(rows):  # one episode, out of order
            order = np.argsort(frame)
            return order, _flagged(piece, order)
        starts = np.r_[True, np.diff(frame) < 0]
        if not (frame[starts] == frame[0]).all() or (np.diff(frame) == 0).any():
            raise ValueError(
                f"column {counter!r} neither continues nor restarts: add a column 'episode' that says which"
                " rows belong together"
            )
        return rows, starts | _flagged(piece, rows)
    starts = _flagged(piece, rows)
    if starts.sum() == 1 < len(rows) and clock is not None and (np.diff(clock) < 0).any():
        again = np.r_[True, np.diff(clock) < 0]
        near = np.abs(clock[again] - clock[0]) < 0.5 * np.median(np.abs(np.diff(clock)))
        if near.all() and (np.diff(np.flatnonzero(again)) > 1).all():
            return rows, again
        order = np.argsort(clock)
        if rises_evenly([clock[order]], room=UNEVEN):
            return order, starts
    return rows, starts


def _flagged(piece: Piece, order: np.ndarray) -> np.ndarray:
    """Returns which of the ordered rows begin an episode by flags of starts and ends; the first one always does."""
    starts = np.arange(len(order)) == 0
    for name, values in piece.states.items():
        kind, flag = kind_of(name)[0], values[order]
        switch = not set(np.unique(flag)) - {0, 1}
        if kind in ("start", "end") and not switch:
            raise ValueError(
                f"column {name!r} of the {kind}s of episodes must be 0 or 1: rename it if it is something else, or drop"
                f" it with {option('drop_columns')}"
            )
        if kind == "start":
            starts = starts | (flag > 0)
        elif kind == "end" or kind == "length" and switch:
            starts = starts | np.r_[False, (flag[:-1] > 0) & (flag[1:] == 0)]  # the flag may stay 1 for several rows
    return starts


def _changes(numbers: np.ndarray) -> np.ndarray:
    return np.r_[True, numbers[1:] != numbers[:-1]]


def _even(pieces: Sequence[Piece]) -> set[str]:
    """Returns state columns that rise by the same amount in every frame of all pieces; none if all do."""
    states = [name for name in pieces[0].states if kind_of(name)[0] is None]
    found = {name for name in states if rises_evenly([piece.states[name] for piece in pieces])}
    return found if len(found) < len(states) else set()


def _other_names(pieces: Sequence[Piece]) -> Iterator[tuple[str, str]]:
    acting = any(piece.actions for piece in pieces)
    cure = f"; name columns alike in all files, or drop those that some lack with {option('drop_columns')}"
    cure = cure if acting else f"; name the action columns of tables in {option('action_columns')}"
    for kind in ("state", "action"):
        named = [(piece.name, piece.states if kind == "state" else piece.actions) for piece in pieces]
        found = [(name, columns) for name, columns in named if columns is not None]
        for name, columns in found[1:]:
            first, wanted = found[0]
            missing, more = (
                some(sorted(rest)) for rest in (wanted.keys() - columns.keys(), columns.keys() - wanted.keys())
            )
            if missing or more:
                said = [f"lacks {missing}"] * bool(missing) + [f"has {more} besides"] * bool(more)
                yield name, f"its {kind} columns are not those of {first}: it {' and '.join(said)}{cure}"


def _camera_faults(pieces: Sequence[Piece]) -> Iterator[str]:
    """Finds pieces without a camera that others have or without a frame per row, and unreadable first frames."""
    for name in dict.fromkeys(name for piece in pieces for name in piece.cameras):
        cure = f"record them, or drop the camera with {option('drop_columns')} {name}"
        absent = [piece.name for piece in pieces if name not in piece.cameras]
        if absent:
            yield f"camera {name!r} has no frames in {some(absent)}: {cure}"
        for piece in pieces:
            number = len(piece.cameras.get(name, range(piece.frames)))
            if number != piece.frames:
                times = f"give their times in {name}_times.npy (beside a table with a clock)"
                yield f"{piece.name}: camera {name!r} has {number} frames for {piece.frames} rows: {times}, {cure}"
        where, clip = next((piece.name, piece.cameras[name]) for piece in pieces if name in piece.cameras)
        try:
            with suppress(RuntimeError):  # the extra that reads it is missing; only `koap embed` needs it
                next(clip.take(range(min(len(clip), 1))).read(), None)
        except ValueError as error:
            yield f"{where}: camera {name!r}: {error}"


def _other_lengths(pieces: Sequence[Piece]) -> Iterator[tuple[str, str]]:
    for piece in pieces:
        for columns in (piece.states, piece.actions or {}):
            lengths: dict[int, list[str]] = {}
            for name, values in columns.items():
                lengths.setdefault(len(values), []).append(name)
            if len(lengths) > 1:
                said = "; ".join(f"{length} in {some(names)}" for length, names in lengths.items())
                yield piece.name, f"its columns have different numbers of rows: {said}"
