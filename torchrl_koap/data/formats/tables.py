# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads recordings from a folder of tables, one trajectory each: NumPy archives, CSV or parquet files.

::

    folder/run_000.npz    states [T, d] (also "state", "observations", "observation", "obs"); optional: actions
                          [T or T - 1, a] (also "action"), state_names, action_names, control_hz
    folder/run_001.csv    a header; a row per frame; columns "action", "action_*", "Action 0" are actions, "timestamp"
                          or "time" is in seconds, "episode" or "episode_index" splits the file into trajectories, and
                          all others are states; an empty field is NaN
    folder/run_002.parquet  the same; columns may also be lists of numbers

Camera frames are beside a table (:mod:`torchrl_koap.data.formats.frames`).

``skipped`` names what is not read: other entries of an archive, parquet columns without numbers.
"""

from __future__ import annotations

import csv
import io
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.clocks import UNEVEN, time_stamps
from torchrl_koap.data.formats.columns import assemble
from torchrl_koap.data.formats.frames import TIMES, clips_beside
from torchrl_koap.data.formats.kinds import as_numbers, is_action, kind_of, named_twice, number_of, numbered
from torchrl_koap.data.formats.parquet import import_pyarrow, number_type, numbers
from torchrl_koap.data.formats.pieces import NEXT_END, Piece, counted_ends, with_last_frames
from torchrl_koap.data.formats.recordings import Recordings, wrong_rate
from torchrl_koap.files import DataError, gathered, option, refuse, some
from torchrl_koap.lookup import unknown

STATES = ("states", "state", "observations", "observation", "obs")
ACTIONS = ("actions", "action")
_HUNDREDS, _THOUSANDS = re.compile(r"-?[1-9]\d\d"), re.compile(r"-?[1-9]\d{0,2}\.\d{3}")
_NEEDED = {"start": "the start of episodes", "end": "the end of episodes", "frame": "a count of frames"}


def table_files(folder: str | Path) -> list[Path]:
    """Returns the tables of a folder in the order of their names, or ``folder`` if it is one."""
    found = [Path(folder)] if Path(folder).is_file() else sorted(Path(folder).glob("[!.]*"))
    return [path for path in found if path.suffix.lower() in _READERS and path.is_file()]


def read_tables(folder: str | Path, *, action_columns: Sequence[str] | None = None, **options: Any) -> Recordings:
    """Reads a folder of tables, or a single one, in the order of their names.

    A table with none of the ``action_columns`` has no actions. NumPy archives hold actions as an entry. The options are
    those of :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    folder, files = Path(folder), table_files(folder)
    archives = [file.name for file in files if file.suffix.lower() == ".npz"]
    if action_columns is not None and archives:
        raise ValueError(
            f"{option('action_columns')}: not an option for NumPy archives ({archives[0]}), whose actions are the entry"
            f" {' or '.join(map(repr, ACTIONS))}"
        )
    faults: list[tuple[str, str]] = []
    pieces: list[Piece] = []
    for file in files:
        try:
            pieces.append(_READERS[file.suffix.lower()](file, action_columns))
        except (ValueError, OSError) as error:
            faults.append((str(file), str(error)))
    refuse(folder, gathered(faults) or _lacking(pieces, action_columns or ()))
    counted = {name: kind_of(name) for piece in pieces if not piece.declared_hz for name in piece.states}
    counted = {name: kind for name, kind in counted.items() if kind[0] in ("clock", "frame")}
    if "clock" in [kind for kind, _ in counted.values()]:  # some files declare a rate, others have time stamps
        pieces = [_stamped(piece, counted) for piece in pieces]
    rates = [piece.declared_hz for piece in pieces if piece.declared_hz]
    if rates and max(rates) > (1 + UNEVEN) * min(rates) and "control_hz" not in options:
        if "resample" not in options or len(rates) < len(pieces):
            said = f"the files have {min(rates):.4g} to {max(rates):.4g} frames per second"
            cure = f"pass {option('resample')} to resample them to one rate, or {option('control_hz')}"
            raise DataError(folder, f"{said}: {cure}")
        pieces = [_stamped(piece, {"timestamp": ("clock", 1.0)}) for piece in pieces]
    beside = {file.with_suffix("") for file in files}
    others = [path for path in sorted(files[0].parent.iterdir()) if path not in files and path not in beside]
    seen = {clip.file for piece in pieces for clip in piece.cameras.values()}
    lies = [path for each in sorted(beside) if each.is_dir() for path in sorted(each.iterdir())]
    lies = [path for path in lies if str(path.resolve()) not in seen and not path.name.endswith(TIMES)]
    return assemble(
        _named_alike(pieces),
        str(folder),
        declared_hz=float(np.median(rates)) if rates else None,
        skipped=[
            *(f"{path.name} (no table)" for path in others if folder.is_dir()),
            *gathered((path.parent.name, f"{path.name} (no frames)") for path in lies),
        ],
        **options,
    )


def _lacking(pieces: Sequence[Piece], action_columns: Sequence[str]) -> list[str]:
    """Reports files with only some of the action columns, and columns that no file has."""
    every = dict.fromkeys(name for piece in pieces for name in (*piece.states, *(piece.actions or ())))
    lacking = [
        (piece.name, f"lacks {some(missing)} of {option('action_columns')}")
        for piece in pieces
        if piece.actions and (missing := [name for name in action_columns if name not in piece.actions])
    ]
    return unknown(action_columns, [*every], f"column in {option('action_columns')}:") or gathered(lacking)


def _stamped(piece: Piece, counted: Mapping[str, tuple[str | None, float]]) -> Piece:
    """Gives a piece that declares a rate the time stamps and frame counts of the others, unless it has its own."""
    if not piece.declared_hz:
        return piece
    rows, stamps = np.arange(piece.frames), np.arange(piece.frames) / piece.declared_hz
    found = {name: stamps / unit if kind == "clock" else rows for name, (kind, unit) in counted.items()}
    return replace(piece, states=found | piece.states, declared_hz=None)


def _entries(file: Path) -> dict[str, np.ndarray]:
    damaged = "it is no NumPy archive, as np.savez writes them, or damaged"
    if not zipfile.is_zipfile(file):
        raise ValueError(damaged)
    try:
        opened = np.load(file, allow_pickle=False)
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise ValueError(damaged) from error
    entries = {}
    with opened as archive:
        for name in archive.files:
            try:
                entries[name] = archive[name]
            except Exception as error:  # damaged archives may raise any exception
                what = "it holds objects (lists of different lengths, or None?), or is damaged"
                raise ValueError(f"entry {name!r} cannot be read: {what}") from error
    return entries


def _read_npz(file: Path, action_columns: Sequence[str] | None) -> Piece:
    entries = _entries(file)
    key = next((name for name in STATES if name in entries), None)
    if key is None:
        held = ", ".join(entries) or "nothing"
        raise ValueError(f"has no states: wanted one of {', '.join(STATES)}, it holds {held}")
    acting = next((name for name in ACTIONS if name in entries), None)
    frames, read = entries[key], {key, acting, "state_names", "action_names", "control_hz"}
    if frames.ndim != 2 or frames.dtype.kind not in "fiub":
        raise ValueError(f"{key} must be numbers [T, d], got {frames.dtype} {list(frames.shape)}")
    states, unclear, unread = _named(frames, entries.get("state_names"), "state"), [], []
    steps = following = None
    for name, values in entries.items():
        if name in read:
            continue
        kind = kind_of(name)[0]
        whole = values.shape[:1] == (len(frames),) and values.ndim < 3 and values.dtype.kind in "fiub"
        single = whole and values.size == len(frames)
        flags = None if single else counted_ends(values, len(frames), kind)
        if name == f"next_{key}" and values.shape == frames.shape and whole:
            following = values
            unread.append(f"{name} (except the last of episodes, which end where it is not the next row: {NEXT_END})")
            continue
        if kind == "other" or kind is None and not single and flags is None:
            joins = whole and kind is None
            unread.append(f"{name} (a row per frame: join it to {key!r} if the policy needs it)" if joins else name)
            continue
        if flags is not None and kind == "start":
            flags = np.roll(flags, 1)  # the first frame of an episode follows the last one of another
        for fault in named_twice(states, {name: values}):
            raise ValueError(fault)
        states[name] = _frame_entry(name, values, len(frames)) if flags is None else flags
        unclear += [name] if kind is None else []
    if acting is not None:
        if entries[acting].ndim != 2 or entries[acting].dtype.kind not in "fiub":
            raise ValueError(f"{acting} must be numbers [T, a] or [T - 1, a], got {list(entries[acting].shape)}")
        steps = _named(entries[acting], entries.get("action_names"), "action")
    elif "action_names" in entries:  # no labels, yet known columns
        steps = _named(np.full((len(frames), entries["action_names"].size), np.nan), entries["action_names"], "action")
    rate = _declared(entries.get("control_hz"))
    piece = _filmed(file, Piece(file.name, states, steps, tuple(unclear), declared_hz=rate, unread=tuple(unread)))
    return piece if following is None else with_last_frames(piece, following, key)


def _declared(entry: np.ndarray | None) -> float | None:
    """Returns the frames per second that an archive declares, or None."""
    if entry is None:
        return None
    found = as_numbers("control_hz", entry.ravel())
    if found is None or len(found) != 1 or wrong_rate(found[0], "control_hz"):
        raise ValueError(f"entry 'control_hz' must be one positive number of frames per second, got {entry}")
    return float(found[0])


def _named_alike(pieces: list[Piece]) -> list[Piece]:
    """Names the columns of archives without names like those of the first named archive of the same width.

    Other entries, such as time stamps, keep their names.
    """

    def named(columns: Any, kind: str, others: list[Any]) -> Any:
        made_up = [name for index, name in enumerate(columns or ()) if name == f"{kind}_{index}"]
        if not made_up:
            return columns
        known = [other for other in others if other and made_up[0] not in other]
        fits = ([name for name in other if name not in columns] for other in known)
        names = next((given for given in fits if len(given) == len(made_up)), made_up)
        return {new: columns[name] for new, name in zip(names, made_up, strict=True)} | {
            name: values for name, values in columns.items() if name not in made_up
        }

    states, actions = [piece.states for piece in pieces], [piece.actions for piece in pieces]
    return [
        replace(piece, states=named(piece.states, "state", states), actions=named(piece.actions, "action", actions))
        for piece in pieces
    ]


def _named(table: np.ndarray, given: np.ndarray | None, kind: str) -> dict[str, np.ndarray]:
    columns = numbered(kind, table)
    names = [*columns] if given is None else np.atleast_1d(given).astype(str).tolist()
    if len(names) != len(columns) or len(set(names)) != len(columns):
        raise ValueError(f"{kind}_names must be {len(columns)} different names, got {', '.join(names)}")
    return dict(zip(names, columns.values(), strict=True))


def _frame_entry(name: str, values: np.ndarray, length: int) -> np.ndarray:
    """Converts an entry with one number, or name of an episode, per frame."""
    if values.shape not in ((length,), (length, 1)):
        raise ValueError(
            f"entry {name!r} must have one number for each of {length} frames, or the ends, starts or lengths of"
            f" episodes that cover all frames; got {values.dtype} {list(values.shape)}"
        )
    found = as_numbers(name, values.ravel())
    if found is None:
        raise ValueError(f"entry {name!r} must be numbers, got {values.dtype}")
    return found


def _read_csv(file: Path, action_columns: Sequence[str] | None) -> Piece:
    try:
        text = file.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("it is no text in UTF-8: save it as CSV UTF-8") from error
    first = next((line for line in text.split("\n") if line.strip() and line[0] != "#"), "")
    separator = max(",;\t", key=first.count)

    def plain(field: str) -> str:
        return field.strip() if separator == "," else field.strip().replace(",", ".")

    reader = csv.reader(io.StringIO(text), delimiter=separator)
    try:
        found = [(reader.line_num, [plain(field) for field in row]) for row in reader]
    except csv.Error as error:
        raise ValueError(f"it is no table: {error}") from error
    filled = [at for at, (_, row) in enumerate(found) if any(row)]
    found = found[filled[0] : filled[-1] + 1] if filled else []
    width = max((len(row) for _, row in found), default=0)
    found = [(line, row) for line, row in found if any(row) or len(row) == width]  # empty fields: a lost frame
    rows = [(line, row) for line, row in found if row[0][:1] != "#"]
    if rows and None not in map(number_of, rows[0][1]):  # numpy.savetxt makes the header a comment
        rows = [*[(line, row) for line, row in found if row[0][:1] == "#" and line < rows[0][0]][-1:], *rows]
    if len(rows) < 2:
        raise ValueError("wanted a header and a row per frame")
    header = [" ".join(name.split()) for name in rows[0][1]]
    header[0] = header[0].lstrip("# ") or "unnamed: 0"  # the row index of pandas
    if None not in map(number_of, header):
        raise ValueError("its first row holds numbers, wanted the names of the columns")
    for place, name in enumerate(header):
        if not name:
            raise ValueError(f"column {place + 1} has no name")
        if header.index(name) != place:
            raise ValueError(f"columns {header.index(name) + 1} and {place + 1} are both named {name!r}")
    for line, row in rows[1:]:
        if len(row) != len(header):
            raise ValueError(f"line {line} has {len(row)} fields, the header has {len(header)}")
    hidden = sum(row[0][:1] == "#" for line, row in found if line > rows[0][0])
    columns: dict[str, np.ndarray | None] = {}
    for name, texts in zip(header, zip(*(row for _, row in rows[1:]), strict=True), strict=True):
        columns[name] = as_numbers(name, np.array(texts))
        odd = [row for row, text in enumerate(texts, 1) if number_of(text) is None]
        if columns[name] is None and len(odd) < len(texts):
            raise ValueError(f"line {rows[odd[0]][0]}, column {name!r}: {texts[odd[0] - 1]!r} is no number")
        parted, whole = [text for text in texts if "." in text], any(map(_HUNDREDS.fullmatch, texts))
        if separator != "," and parted and whole and all(map(_THOUSANDS.fullmatch, parted)):
            said = f"{parted[0].replace('.', ',')}, which may be {parted[0].replace('.', '')} or {float(parted[0]):g}"
            raise ValueError(f"column {name!r} holds {said}: write thousands without a separator")
    piece = _split(file, columns, action_columns)
    return replace(piece, unread=(*piece.unread, *[f"{hidden} rows of {file.name} that begin with #"] * bool(hidden)))


def _read_parquet(file: Path, action_columns: Sequence[str] | None) -> Piece:
    pyarrow = import_pyarrow()
    try:
        names = pyarrow.parquet.read_schema(file).names
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValueError(f"two columns are named {some(twice)}")
        table = pyarrow.parquet.read_table(file)
    except pyarrow.ArrowException as error:
        raise ValueError("it is no parquet file, or damaged") from error
    columns: dict[str, np.ndarray | None] = {}
    for name in table.column_names:
        values = table[name]
        kind = number_type(values.type)
        if is_action(name) and values.null_count == len(values) and kind in (None, pyarrow.list_(pyarrow.float64())):
            continue  # no labels, and no width
        whole = pyarrow.types.is_integer(values.type)
        if kind is None or whole:  # text, dates, pictures, numbers of episodes
            plain = whole or pyarrow.types.is_temporal(values.type)
            found = {name: as_numbers(name, values.to_numpy() if plain else np.array(values.to_pylist(), dtype=object))}
        else:
            block = numbers(values.cast(kind, safe=False), name)
            found = numbered(name, block) if pyarrow.types.is_list(kind) else {name: block[:, 0]}
        for fault in named_twice(columns, found):
            raise ValueError(fault)
        columns |= found
    return _split(file, columns, action_columns)


_READERS = {".npz": _read_npz, ".csv": _read_csv, ".parquet": _read_parquet}


def _split(file: Path, columns: Mapping[str, np.ndarray | None], action_columns: Sequence[str] | None) -> Piece:
    """Splits a table into states and actions; columns are None if they hold no numbers."""
    acting = [name for name in columns if is_action(name)]
    if action_columns is not None:
        acting = [name for name in action_columns if name in columns]  # none: a recording without actions
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
    said = tuple(f"{name} (no numbers)" for name in unread)
    return _filmed(file, Piece(file.name, states, {name: known[name] for name in acting} or None, unread=said))


def _filmed(file: Path, piece: Piece) -> Piece:
    """Adds the cameras beside a table, whose rows are those of the piece."""
    (clock,) = next(iter(time_stamps([piece.clocks]).values()), [None])
    return replace(piece, cameras=clips_beside(file, clock))
