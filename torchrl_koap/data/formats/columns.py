# This source code is licensed under the MIT license found in the LICENSE file.
"""From named columns to recordings, for every reader: what is a state, where episodes end, the rate of the frames."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchrl_koap.data.formats.recordings import Recordings, make_recordings
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
UNEVEN = 0.2  # share of the usual step by which a step in time may differ
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

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data.formats.columns import Piece, assemble
        >>> columns = {"t_ms": 50 * np.arange(4), "done": np.array([0, 1, 0, 1]), "x": np.arange(4.0)}
        >>> found = assemble([Piece("run.csv", columns, {"v": np.ones(4)})], "recordings")
        >>> found.sources, found.control_hz, found.state_names, found.skipped
        (('run.csv[0]', 'run.csv[1]'), 20.0, ('x',), ('t_ms', 'done'))
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
    """What a column is by its name, None for a state; and its unit in seconds.

    Examples:
        >>> from torchrl_koap.data.formats.columns import kind_of
        >>> kind_of("Timestamp [ms]"), kind_of("is_success"), kind_of("joint_1")
        (('clock', 0.001), ('other', 1.0), (None, 1.0))
    """
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
        control_hz (float, optional): frames per second, whatever source and time stamps say.
        state_columns (sequence of str): columns that make up the state, in that order. Default: all that are no clock,
            counter, reward or flag of an episode.
        drop_columns (sequence of str): state and action columns that are left out.
        action_dim (int, optional): number of action columns, where nothing has actions.
        action_names (sequence of str, optional): their names, where nothing has actions.
        skipped (sequence of str): entries that the reader left out.
        no_rate (str): what is said where nothing tells the rate.

    Raises:
        DataError: with all faults.
    """
    if not pieces:
        raise DataError(source, "there are no trajectories")
    problems: list[str] = []
    _check_names(pieces, problems)
    if problems:
        raise DataError(source, problems)
    pieces = [part for piece in pieces for part in _episodes(piece, problems)]
    names = list(pieces[0].states)
    acting = next((list(piece.actions) for piece in pieces if piece.actions is not None), None)
    for option, asked, known in (
        ("state_columns", state_columns, names),
        ("drop_columns", drop_columns, [*names, *(acting or [])]),
    ):
        for column in asked:
            try:
                lookup(known, column, f"column in {option}:")
            except ValueError as error:
                problems.append(str(error))
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
        problems.append(f"{pieces[0].name}: has no state columns, only {', '.join([*(acting or []), *names])}")
    if acting is not None:
        left_out += [name for name in acting if name in drop_columns]
        acting = [name for name in acting if name not in drop_columns]
    rate = control_hz if control_hz is not None else _find_rate(pieces, declared_hz, no_rate, problems)
    if problems:
        raise DataError(source, problems)
    return make_recordings(
        [np.stack([_float(piece.states[name]) for name in observed], 1) for piece in pieces],
        [None if not piece.actions or not acting else _stack(piece, acting) for piece in pieces],
        action_dim=action_dim,
        state_names=observed,
        action_names=acting or action_names,
        sources=[piece.name for piece in pieces],
        control_hz=rate,
        skipped=left_out,
        source=source,
    )


def _find_rate(pieces: Sequence[Piece], declared: float | None, otherwise: str, problems: list[str]) -> float | None:
    """Frames per second by the time stamps of all pieces; what is declared where there are none."""
    clock = next((name for name in pieces[0].states if kind_of(name)[0] == "clock"), None)
    if clock is None:
        if declared is None:
            problems.append(otherwise)
        return declared
    steps = {piece.name: np.diff(piece.states[clock].astype(np.float64)) * kind_of(clock)[1] for piece in pieces}
    back = [name for name, step in steps.items() if not (step > 0).all()]
    if back or not sum(map(len, steps.values())):
        where = f" in {len(back)} of {len(steps)} trajectories ({some(back)})" if back else ""
        problems.append(f"time stamps do not increase: column {clock!r}{where}; pass control_hz if they mean nothing")
        return None
    usual = float(np.median(np.concatenate(list(steps.values()))))
    if not SLOWEST <= 1 / usual <= FASTEST:
        problems.append(
            f"column {clock!r} says {1 / usual:.3g} frames per second if it is in seconds: name it {clock}_ms,"
            f" {clock}_us or {clock}_ns if it is in another unit, or pass control_hz"
        )
        return None
    uneven = {name: step for name, step in steps.items() if np.abs(step - usual).max(initial=0) > UNEVEN * usual}
    if uneven:
        listed = [
            f"{name}: frames are {step.min():.4g} to {step.max():.4g} s apart (frame {np.abs(step - usual).argmax()})"
            for name, step in uneven.items()
        ]
        problems.append(
            f"{some(listed)}; the usual step is {usual:.4g} s: resample them to a fixed rate first, or pass control_hz"
            " if the stamps are wrong"
        )
    if declared is not None and abs(declared * usual - 1) > UNEVEN:
        problems.append(
            f"column {clock!r} says {1 / usual:.4g} frames per second, the source declares {declared:g}:"
            " pass control_hz"
        )
    return float(1 / usual) if declared is None else declared


def _episodes(piece: Piece, problems: list[str]) -> list[Piece]:
    """The episodes of a piece: by their number, by a frame counter that starts again, by flags of their end."""
    length = len(next(iter(piece.states.values()), ()))
    found = {kind_of(name)[0]: name for name in reversed(piece.states)}
    number, frame = (piece.states[found[kind]] if kind in found else None for kind in ("episode", "frame"))
    ends = [values for name, values in piece.states.items() if kind_of(name)[0] == "end"]
    order = np.arange(length)
    if number is not None:
        starts = np.r_[True, number[1:] != number[:-1]]
        sorting = frame if frame is not None else piece.states[found["clock"]] if "clock" in found else None
        if starts.sum() > len(np.unique(number)):
            pairs = None if sorting is None else np.unique(np.stack([number, sorting], 1), axis=0)
            if pairs is None or len(pairs) < length:
                again = next(value for value in number[starts] if (number[starts] == value).sum() > 1)
                problems.append(
                    f"{piece.name}: {found['episode']} {again:g} comes back after another one, and no frame index or"
                    " time says how its rows follow each other"
                )
                return [piece]
        if sorting is not None:
            order = np.lexsort((sorting, number))
        number = number[order]
        starts = np.r_[True, number[1:] != number[:-1]]
    elif frame is not None and (np.diff(frame) <= 0).any():
        starts = np.r_[True, np.diff(frame) < 0]
        if len(np.unique(frame)) == length:  # one episode, out of order
            order, starts = np.argsort(frame), order == 0
        elif not (frame[starts] == frame[0]).all() or (np.diff(frame) == 0).any():
            problems.append(
                f"{piece.name}: column {found['frame']!r} neither counts on nor starts again: a column 'episode' says"
                " which rows belong together"
            )
            return [piece]
    else:
        starts = order == 0
        for flag in ends:  # an episode ends where a flag falls
            starts = starts | np.r_[False, (flag[:-1] > 0) & (flag[1:] == 0)]
        if ends and any(set(np.unique(flag)) - {0, 1} for flag in ends):
            problems.append(f"{piece.name}: columns of the ends of episodes must be 0 or 1")
    starts = np.flatnonzero(starts)
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
        Piece(name, _rows(piece.states, span), piece.actions and _rows(piece.actions, span), piece.unclear)
        for name, span in zip(names, spans, strict=True)
    ]


def _rows(columns: Mapping[str, np.ndarray], span: np.ndarray) -> dict[str, np.ndarray]:
    return {name: values[span] for name, values in columns.items()}


def _even(pieces: Sequence[Piece]) -> set[str]:
    """State columns that rise by the same amount in every frame of all pieces; none if that would be all."""
    found = set()
    states = [name for name in pieces[0].states if kind_of(name)[0] is None]
    for name in states:
        steps = np.concatenate([np.diff(_float(piece.states[name])) for piece in pieces])
        first = steps[0] if len(steps) >= _LONG else 0.0
        if first > 0 and np.allclose(steps, first, rtol=1e-6, atol=0):
            found.add(name)
    return found if len(found) < len(states) else set()


def _check_names(pieces: Sequence[Piece], problems: list[str]) -> None:
    for kind in ("state", "action"):
        named = [(piece.name, piece.states if kind == "state" else piece.actions) for piece in pieces]
        found = [(name, list(columns)) for name, columns in named if columns is not None]
        problems += [
            f"{name}: {kind} columns are {', '.join(columns)}; those of {found[0][0]} are {', '.join(found[0][1])}"
            for name, columns in found
            if columns != found[0][1]
        ]
    for piece in pieces:
        for columns in (piece.states, piece.actions or {}):
            lengths = {len(values) for values in columns.values()}
            if len(lengths) > 1:
                shapes = ", ".join(f"{name} {len(values)}" for name, values in columns.items())
                problems.append(f"{piece.name}: its columns have different numbers of rows: {shapes}")


def _float(values: np.ndarray) -> np.ndarray:
    return values.astype(np.float64) if values.dtype.kind in "fiub" else values


def _stack(piece: Piece, names: Sequence[str]) -> np.ndarray:
    return np.stack([_float((piece.actions or {})[name]) for name in names], 1)
