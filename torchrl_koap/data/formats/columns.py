# This source code is licensed under the MIT license found in the LICENSE file.
"""Converts named columns to recordings, for all readers: selects states, finds the frame rate, checks the rest."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping, Sequence
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
    parts = [part for piece in pieces for part in split_episodes(piece, problems)]
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
        pieces = [piece.taken(np.flatnonzero(rows)) for piece, rows in zip(pieces, seen_in, strict=True)]
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
