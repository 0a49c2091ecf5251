# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts named columns to recordings, for all readers: selects states, finds the frame rate, checks the rest."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from torchrl_koap.data.formats.clocks import NOT_READ, clocks_of, find_rate, rises_evenly, told_rate, usual_rate
from torchrl_koap.data.formats.kinds import kind_of
from torchrl_koap.data.formats.pieces import Piece, split_episodes
from torchrl_koap.data.formats.recordings import Recordings, make_recordings
from torchrl_koap.data.formats.resampling import resampled
from torchrl_koap.files import DataError, gathered, option, refuse, some
from torchrl_koap.lookup import unknown


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
    pieces, problems = _chosen(pieces, source, [*seen], state_columns, drop_columns)
    parts = [part for piece in pieces for part in split_episodes(piece, problems)]
    short = [f"{part.name} (fewer than two frames)" for part in parts if part.frames < 2]
    pieces = [part for part in parts if part.frames > 1]
    if not pieces:
        raise DataError(source, problems or [f"none of its {len(parts)} trajectories has two frames"])
    names = list(pieces[0].states)
    acting = next((list(piece.actions) for piece in pieces if piece.actions is not None), [])
    if not state_columns:
        problems += _unclear(pieces, drop_columns)
    even = set() if state_columns else _even(pieces)
    usable = [name for name in names if kind_of(name)[0] is None and name not in even]
    observed = [name for name in state_columns or usable if name not in drop_columns]
    about = dict.fromkeys(even, " (it rises evenly: a clock)") | _failures(pieces, seen)
    clock, others = None, clocks_of([piece.clocks for piece in pieces], [piece.name for piece in pieces])
    if others and control_hz is None:
        clock = others.pop(0)
        rate = find_rate(clock, declared_hz, problems) if resample is None else usual_rate(clock, problems)
    else:
        problems += gathered(_lost_frames(pieces))
        rate = declared_hz if control_hz is None else control_hz
        problems += [f"{no_rate}: pass {option('control_hz')}"] if rate is None else []
    about |= {other.name: told_rate(other, rate) for other in others if rate is not None}
    if others and control_hz is not None and (against := about[others[0].name]) not in ("", NOT_READ):
        warnings.warn(
            f"column {others[0].name!r}{against} is overridden by {option('control_hz')} {control_hz:g}: if its stamps"
            f" are right, pass only {option('resample')} {resample or control_hz:g}",
            stacklevel=2,
        )
    left_out = [*skipped, *short, *(name + about.get(name, "") for name in seen if name not in observed)]
    left_out += [name for name in drop_columns if name not in left_out]
    if not observed:
        problems.append(f"{pieces[0].name}: has no state columns, only {', '.join([*acting, *names])}")
    refuse(source, problems)
    times = None
    if resample is not None:
        times = [np.arange(piece.frames) / rate for piece in pieces] if clock is None else clock.times
        pieces, times, lost = _with_states(pieces, times, observed)
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


def _chosen(
    pieces: Sequence[Piece],
    source: str,
    seen: Sequence[str],
    state_columns: Sequence[str],
    drop_columns: Sequence[str],
) -> tuple[list[Piece], list[str]]:
    """Returns pieces with the columns that are used, and problems of options; refuses pieces that differ."""
    every = dict.fromkeys(name for piece in pieces for name in (*piece.states, *(piece.actions or ()), *piece.cameras))
    problems = unknown(state_columns, seen, f"column in {option('state_columns')}:")
    problems += unknown(drop_columns, [*every], f"column in {option('drop_columns')}:")
    used = {name for name in seen if not state_columns or name in state_columns or kind_of(name)[0] is not None}
    chosen = [
        replace(
            piece,
            states={name: values for name, values in piece.states.items() if name in used - {*drop_columns}},
            actions=_without(piece.actions or {}, drop_columns) or None,
            cameras=_without(piece.cameras, drop_columns),
        )
        for piece in pieces
    ]
    refuse(source, problems + gathered([*_other_names(chosen), *_other_lengths(chosen)]))
    refuse(source, list(_camera_faults(chosen)))
    return chosen, problems


def _unclear(pieces: Sequence[Piece], drop_columns: Sequence[str]) -> list[str]:
    """Returns a list with a message if the user must state what columns mean, else an empty list."""
    unclear = dict.fromkeys(name for piece in pieces for name in piece.unclear if name not in drop_columns)
    if not unclear:
        return []
    return [
        f"{', '.join(map(repr, unclear))} may be the episode of each frame, or the ends of episodes: if so, name it"
        " episode_index, timeouts or episode_ends; if it is a column of the states or the actions, store it there;"
        f" otherwise name the state's columns in {option('state_columns')}, or drop it with {option('drop_columns')}"
    ]


def _failures(pieces: Sequence[Piece], names: Iterable[str]) -> dict[str, str]:
    """Returns, for flags of success by name, a note on how many trajectories have none."""
    flags = [name for name in names if "success" in name.lower() and kind_of(name)[0] == "other"]
    failed = {name: sum(not part.states[name].any() for part in pieces if name in part.states) for name in flags}
    return {name: f" (0 throughout {count} trajectories, which are kept)" for name, count in failed.items() if count}


def _with_states(
    pieces: Sequence[Piece], times: Sequence[np.ndarray], observed: Sequence[str]
) -> tuple[list[Piece], list[np.ndarray], int]:
    """Leaves out frames without states in pieces without labels; returns pieces, times and how many were left out."""
    pieces = [piece if _labelled(piece) else replace(piece, actions=None) for piece in pieces]
    kept = [np.isfinite(_stack(piece.states, observed)).all(1) | bool(piece.actions) for piece in pieces]
    times = [at[rows] for at, rows in zip(times, kept, strict=True)]
    pieces = [piece.taken(np.flatnonzero(rows)) for piece, rows in zip(pieces, kept, strict=True)]
    return pieces, times, sum(int((~rows).sum()) for rows in kept)


def _labelled(piece: Piece) -> bool:
    return any(np.isfinite(values).any() for values in (piece.actions or {}).values())


def _without(columns: Mapping[str, Any], dropped: Sequence[str]) -> dict[str, Any]:
    return {name: values for name, values in columns.items() if name not in dropped}


def _stack(columns: Mapping[str, np.ndarray], names: Sequence[str]) -> np.ndarray:
    return np.stack([columns[name] for name in names], 1).astype(np.float64)


def _lost_frames(pieces: Sequence[Piece]) -> Iterator[tuple[str, str]]:
    """Finds pieces whose frame counter skips numbers; used where no clock shows lost frames."""
    for piece in pieces:
        for name, frame in piece.of_kind("frame").items():
            steps = np.diff(frame)
            lost = np.flatnonzero(steps != np.median(steps))
            if len(lost):
                before, after = frame[lost[0] : lost[0] + 2]
                yield (
                    piece.name,
                    f"column {name!r} goes from {before:g} to {after:g}: add the missing frames, end an episode there"
                    f" (a column 'episode_index'), or drop the counter with {option('drop_columns')}",
                )


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
        drop = f"drop the camera with {option('drop_columns')} {name}"
        absent = [piece.name for piece in pieces if name not in piece.cameras]
        if absent:
            yield f"camera {name!r} has no frames in {some(absent)}: record them, or {drop}"
        for piece in pieces:
            number = len(piece.cameras.get(name, range(piece.frames)))
            if number != piece.frames:
                times = f"give their times in {name}_times.npy (beside a table with a clock)"
                said = f"camera {name!r} has {number} frames for {piece.frames} rows: {times}, record them, or {drop}"
                yield f"{piece.name}: {said}"
        where, clip = next((piece.name, piece.cameras[name]) for piece in pieces if name in piece.cameras)
        try:
            with suppress(RuntimeError):  # the extra that reads it is missing; only `koap embed` needs it
                next(clip.take(range(min(len(clip), 1))).read(), None)
        except ValueError as error:
            yield f"{where}: camera {name!r}: {error}; or {drop}"


def _other_lengths(pieces: Sequence[Piece]) -> Iterator[tuple[str, str]]:
    for piece in pieces:
        for columns in (piece.states, piece.actions or {}):
            lengths: dict[int, list[str]] = {}
            for name, values in columns.items():
                lengths.setdefault(len(values), []).append(name)
            if len(lengths) > 1:
                said = "; ".join(f"{length} in {some(names)}" for length, names in lengths.items())
                yield piece.name, f"its columns have different numbers of rows: {said}"
