# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from a folder of tables: NumPy archives, CSV or parquet files, a trajectory each.

::

    folder/run_000.npz    states [T, d] (also "state", "observations", "observation", "obs"), actions [T or T - 1, a]
                          (also "action"), or none; state_names, action_names, control_hz if wanted
    folder/run_001.csv    a header; a row per frame; columns "action", "action_*" or "action.*" are actions, "timestamp"
                          or "time" is in seconds, "episode" or "episode_index" splits the file into trajectories, and
                          all others are states; an empty field is NaN
    folder/run_002.parquet  the same; columns may also be lists of numbers

Cameras lie beside a table (:mod:`torchrl_koap.data.formats.frames`).

What is not read (further entries of an archive, parquet columns without numbers) is named in ``skipped``.
"""

from __future__ import annotations

import csv
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.arrow import import_pyarrow, number_type, numbers
from torchrl_koap.data.formats.clocks import UNEVEN
from torchrl_koap.data.formats.columns import UNITS, Piece, assemble, kind_of, numbered
from torchrl_koap.data.formats.frames import clips_beside
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError, some
from torchrl_koap.lookup import lookup

# what readers of damaged files raise
_UNREADABLE = (ValueError, OSError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, csv.Error)
STATES = ("states", "state", "observations", "observation", "obs")
ACTIONS = ("actions", "action")
_TRUTH = {"true": 1.0, "false": 0.0}
_NEEDED = {"start": "the start of episodes", "end": "the end of episodes", "frame": "a count of frames"}
_Table = tuple[Piece, "float | None", list[str]]  # columns, declared rate, and what is not read


def is_table_folder(folder: str | Path) -> bool:
    """Whether a folder holds tables of this kind."""
    return any(_files(Path(folder)))


def read_tables(folder: str | Path, *, action_columns: Sequence[str] | None = None, **options: Any) -> Recordings:
    """Reads a folder of tables, in the order of their names.

    Args:
        folder (str or Path): the folder.
        action_columns: as for :func:`~torchrl_koap.data.read_recordings`; in NumPy archives actions are an entry.
        options: of :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    folder = Path(folder)
    files = _files(folder)
    if not files:
        raise FileNotFoundError(f"{folder} holds no *.npz, *.csv or *.parquet files")
    archives = [file.name for file in files if file.suffix.lower() == ".npz"]
    if action_columns is not None and archives:
        raise ValueError(
            f"action_columns: not an option for NumPy archives ({archives[0]}), whose actions are the entry"
            f" {' or '.join(map(repr, ACTIONS))}"
        )
    problems: dict[str, list[str]] = {}
    tables: list[_Table] = []
    for file in files:
        try:
            piece, rate, unread = _READERS[file.suffix.lower()](file, action_columns)
            tables.append((_with_cameras(piece, file), rate, unread))
        except _UNREADABLE as error:
            problems.setdefault(str(error) or type(error).__name__, []).append(str(file))
    if problems:
        raise DataError(folder, [f"{some(names)}: {said}" for said, names in problems.items()])
    rates = [rate for _, rate, _ in tables if rate]
    if rates and max(rates) > (1 + UNEVEN) * min(rates) and "control_hz" not in options:
        if "resample" not in options or len(rates) < len(tables):
            said = f"the files have {min(rates):.4g} to {max(rates):.4g} frames per second"
            raise DataError(folder, f"{said}: pass resample (Hz) to bring them to one rate, or control_hz")
        tables = [(_stamped(piece, rate), None, names) for (piece, _, names), rate in zip(tables, rates, strict=True)]
    beside = {file.with_suffix("") for file in files}
    others = [path for path in sorted(folder.iterdir()) if path not in files and path not in beside]
    unread = [f"{path.name} (no table)" for path in others]
    return assemble(
        _named_alike([piece for piece, _, _ in tables]),
        str(folder),
        declared_hz=float(np.median(rates)) if rates else None,
        skipped=[*(name for _, _, names in tables for name in names), *unread],
        **options,
    )


def _with_cameras(piece: Piece, file: Path) -> Piece:
    """A table and what cameras saw beside it, by its clock where it has one."""
    clocks = [(name, kind_of(name)[1]) for name in piece.states if kind_of(name)[0] == "clock"]
    clock = piece.states[clocks[0][0]] * clocks[0][1] if clocks else None
    return replace(piece, cameras=clips_beside(file, clock))


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.suffix.lower() in _READERS and path.is_file())


def _stamped(piece: Piece, rate: float) -> Piece:
    """A piece with time stamps by its rate, unless it has some."""
    frames = len(next(iter(piece.states.values())))
    return replace(piece, states={"timestamp": np.arange(frames) / rate} | piece.states)


def _read_npz(file: Path, action_columns: Sequence[str] | None) -> _Table:
    entries = {}
    with np.load(file, allow_pickle=False) as archive:
        for name in archive.files:
            try:
                entries[name] = archive[name]
            except ValueError as error:
                what = f"entry {name!r} cannot be read: it holds objects (lists of different lengths?), or is damaged"
                raise ValueError(what) from error
    key = next((name for name in STATES if name in entries), None)
    if key is None:
        held = ", ".join(entries) or "nothing"
        raise ValueError(f"has no states: wanted one of {', '.join(STATES)}, it holds {held}")
    acting = next((name for name in ACTIONS if name in entries), None)
    frames, read = entries[key], {key, acting, "state_names", "action_names", "control_hz"}
    if frames.ndim != 2 or frames.dtype.kind not in "fiub":
        raise ValueError(f"{key} must be numbers [T, d], got {frames.dtype} {list(frames.shape)}")
    states, unclear, unread, steps = _named(frames, entries.get("state_names"), "state"), [], [], None
    for name, values in entries.items():
        kind = kind_of(name)[0]
        counted = _counted(values, len(frames), kind)
        single = values.shape in ((len(frames),), (len(frames), 1)) and values.dtype.kind in "fiub"
        if name in read:
            continue
        if kind == "other" or kind is None and not single and counted is None:
            unread.append(name)
            continue
        flags = None if single else counted
        if flags is not None and kind == "start":
            flags = np.roll(flags, 1)  # the first frame of an episode lies behind the last one of another
        states[name] = _frame_entry(name, values, len(frames)) if flags is None else flags
        unclear += [name] if kind is None else []
    if acting is not None:
        if entries[acting].ndim != 2 or entries[acting].dtype.kind not in "fiub":
            raise ValueError(f"{acting} must be numbers [T, a] or [T - 1, a], got {list(entries[acting].shape)}")
        steps = _named(entries[acting], entries.get("action_names"), "action")
    rate = float(entries["control_hz"]) if "control_hz" in entries else None
    return Piece(file.name, states, steps, tuple(unclear)), rate, unread


def _named_alike(pieces: list[Piece]) -> list[Piece]:
    """Archives without names take those of the first archive of their width that has some."""

    def named(columns: Any, made_up: str, others: list[Any]) -> Any:
        if not columns or made_up not in columns:
            return columns
        fits = (other for other in others if other and len(other) == len(columns) and made_up not in other)
        return dict(zip(next(fits, columns), columns.values(), strict=True))

    states, actions = [piece.states for piece in pieces], [piece.actions for piece in pieces]
    return [
        replace(piece, states=named(piece.states, "state_0", states), actions=named(piece.actions, "action_0", actions))
        for piece in pieces
    ]


def _named(table: np.ndarray, given: np.ndarray | None, kind: str) -> dict[str, np.ndarray]:
    """Columns of a table by name."""
    width = table.shape[1]
    names = [f"{kind}_{index}" for index in range(width)] if given is None else [str(name) for name in given]
    if len(names) != width or len(set(names)) != width:
        raise ValueError(f"{kind}_names must be {width} different names, got {', '.join(names)}")
    return {name: table[:, index] for index, name in enumerate(names)}


def _counted(values: np.ndarray, length: int, kind: str | None) -> np.ndarray | None:
    """Flags ``[length]`` of the last frames of episodes, of the lengths, ends or starts that the kind of an entry says.

    Of an entry of no kind they are there if its numbers could be lengths or ends.
    """
    if values.ndim != 1 or values.dtype.kind not in "iu" or not 0 < len(values) < length:
        return None
    rises = bool((np.diff(values.astype(np.int64)) > 0).all())
    if kind in ("end", None) and rises and values[-1] in (length, length - 1):
        last = values - (values[-1] == length)
    elif kind in ("length", None) and values.sum() == length and values.all():
        last = values.cumsum() - 1
    elif kind == "start" and rises and values[0] == 0:
        last = np.append(values[1:], length) - 1
    else:
        return None
    return np.isin(np.arange(length), last).astype(np.float64)


def _frame_entry(name: str, values: np.ndarray, length: int) -> np.ndarray:
    """An entry about frames, one number each, or the name of an episode."""
    if values.shape not in ((length,), (length, 1)):
        raise ValueError(f"entry {name!r} must have one number for each of {length} frames, got {list(values.shape)}")
    if kind_of(name)[0] == "episode" and values.dtype.kind in "US":
        return numbered(values.ravel().tolist())
    if values.dtype.kind not in "fiub":
        raise ValueError(f"entry {name!r} must be numbers, got {values.dtype}")
    return values.ravel().astype(np.float64)


def _read_csv(file: Path, action_columns: Sequence[str] | None) -> _Table:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8: save it as CSV UTF-8") from error
    separator = max(",;\t", key=text.partition("\n")[0].count)
    rows = [row for row in csv.reader(text.splitlines(), delimiter=separator) if any(field.strip() for field in row)]
    if len(rows) < 2:
        raise ValueError("wanted a header and a row per frame")
    header = [name.strip() for name in rows[0]]
    header[0] = header[0] or "unnamed: 0"  # the index of the rows, as pandas writes and reads it
    if all(_number(name, comma=separator != ",") is not None for name in header):
        raise ValueError("its first row holds numbers, wanted the names of the columns")
    for number, name in enumerate(header):
        if not name:
            raise ValueError(f"column {number + 1} has no name")
        if header.index(name) != number:
            raise ValueError(f"columns {header.index(name) + 1} and {number + 1} are both named {name!r}")
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise ValueError(f"row {number} has {len(row)} fields, the header has {len(header)}")
    columns: dict[str, np.ndarray | None] = {}
    for name, fields in zip(header, zip(*rows[1:], strict=True), strict=True):
        values = [_number(field.strip(), comma=separator != ",") for field in fields]
        odd = [row for row, value in enumerate(values) if value is None]
        if odd and kind_of(name)[0] == "episode":
            values, odd = numbered(fields), []
        if 0 < len(odd) < len(values):
            raise ValueError(f"row {odd[0] + 2}, column {name!r}: {fields[odd[0]]!r} is no number")
        columns[name] = (_dates(fields) if kind_of(name)[0] == "clock" else None) if odd else np.array(values)
    return _split(file, columns, action_columns)


def _dates(fields: Sequence[object]) -> np.ndarray | None:
    """Dates with times as seconds, None if one is none."""
    try:
        return (np.array(fields, dtype="datetime64[ns]") - np.datetime64(0, "ns")) / np.timedelta64(1, "s")
    except ValueError:
        return None


def _number(field: str, *, comma: bool) -> float | None:
    """What a field says: NaN if it is empty, 0 or 1 for a truth, None if it is text."""
    field = field.replace(",", ".") if comma else field
    try:
        return _TRUTH[field.lower()] if field.lower() in _TRUTH else float(field or "nan")
    except ValueError:
        return None


def _read_parquet(file: Path, action_columns: Sequence[str] | None) -> _Table:
    pyarrow = import_pyarrow()
    try:
        table = pyarrow.parquet.read_table(file)
    except pyarrow.ArrowException as error:
        raise ValueError(f"cannot be read: {str(error).splitlines()[0]}") from error
    columns: dict[str, np.ndarray | None] = {}
    for name in table.column_names:
        values = table[name]
        if pyarrow.types.is_boolean(values.type):
            values = values.cast(pyarrow.int8())
        dated = pyarrow.types.is_timestamp(values.type) or pyarrow.types.is_duration(values.type)
        if dated and kind_of(name)[0] == "clock":
            columns[name] = values.cast(pyarrow.int64()).to_numpy() * UNITS[values.type.unit]
            continue
        kind = number_type(values.type)
        if kind is None:  # text, dates, pictures
            columns[name] = numbered(values.to_pylist()) if kind_of(name)[0] == "episode" else None
            continue
        block = numbers(values.cast(kind), name)
        alone = not pyarrow.types.is_list(kind)
        columns |= {name if alone else f"{name}_{index}": block[:, index] for index in range(block.shape[1])}
    return _split(file, columns, action_columns)


_READERS = {".npz": _read_npz, ".csv": _read_csv, ".parquet": _read_parquet}


def _split(file: Path, columns: Mapping[str, np.ndarray | None], action_columns: Sequence[str] | None) -> _Table:
    """States and actions of a table with named columns, None where they hold no numbers."""
    acting = [name for name in columns if name == "action" or name.startswith(("action_", "action."))]
    if action_columns is not None:
        acting = [name for name in action_columns if lookup(columns, name, "action column") is not None]
    unread = [name for name, values in columns.items() if values is None]
    for name in unread:
        what = "an action" if name in acting else _NEEDED.get(kind_of(name)[0])
        if what is not None:
            raise ValueError(f"column {name!r} is {what} and holds no numbers")
    known = {name: values for name, values in columns.items() if values is not None}
    if not known:
        raise ValueError(
            f"no column holds numbers: {', '.join(columns)} (fields lie between commas, semicolons or tabs)"
        )
    states = {name: values for name, values in known.items() if name not in acting}
    return Piece(file.name, states, {name: known[name] for name in acting} or None), None, unread
