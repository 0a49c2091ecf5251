# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from a folder of tables: NumPy archives, CSV or parquet files, a trajectory each.

::

    folder/run_000.npz    states [T, d] (also "state", "observations", "observation", "obs"), actions [T or T - 1, a]
                          (also "action"), or none; state_names, action_names, control_hz if wanted
    folder/run_001.csv    a header; a row per frame; columns "action", "action_*" or "action.*" are actions, "timestamp"
                          or "time" is in seconds, "episode" or "episode_index" splits the file into trajectories, and
                          all others are states; an empty field is NaN
    folder/run_002.parquet  the same; columns may also be lists of numbers

What is not read (further entries of an archive, parquet columns without numbers) is named in ``skipped``.
"""

from __future__ import annotations

import csv
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from torchrl_koap.data.formats.arrow import import_pyarrow, number_type, numbers
from torchrl_koap.data.formats.recordings import Recordings, make_recordings
from torchrl_koap.files import DataError
from torchrl_koap.lookup import lookup

# what readers of damaged files raise
_UNREADABLE = (ValueError, OSError, KeyError, TypeError, EOFError, zipfile.BadZipFile, zlib.error, csv.Error)
STATES = ("states", "state", "observations", "observation", "obs")
ACTIONS = ("actions", "action")
TIMES = ("timestamp", "timestamps", "time", "t")
EPISODES = ("episode_index", "episode", "trajectory")
_COUNTERS = ("frame_index", "index", "task_index", "step")
_UNEVEN = 0.2  # share of the median step by which steps in time may differ before a rate cannot be read off


@dataclass(frozen=True)
class _Table:
    """What a file holds: trajectories, names of their columns where it has any, rate, and what is not read."""

    trajectories: list[tuple[np.ndarray, np.ndarray | None]]
    state_names: list[str] | None
    action_names: list[str] | None
    rate: float | None
    unread: list[str]


def is_table_folder(folder: str | Path) -> bool:
    """Whether a folder holds tables of this kind."""
    return any(_files(Path(folder)))


def read_tables(
    folder: str | Path,
    *,
    control_hz: float | None = None,
    action_columns: Sequence[str] | None = None,
    action_dim: int | None = None,
) -> Recordings:
    """Reads a folder of ``*.npz``, ``*.csv`` or ``*.parquet`` files.

    Args:
        folder (str or Path): the folder; files are taken in the order of their names.

    Keyword Args:
        control_hz (float, optional): frames per second. Default: from the files' time stamps or ``control_hz`` entry.
        action_columns (sequence of str, optional): columns of CSV and parquet files that are actions, if they are not
            named ``action...``. In NumPy archives actions are an entry of their own.
        action_dim (int, optional): number of action columns, where no file has actions.

    Raises:
        ValueError: for ``action_columns`` where a file is a NumPy archive.
        DataError: with the faults of all files, named: unreadable, without states, of other columns, or without
            a rate in time.
        FileNotFoundError: if the folder holds no such file.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data.formats.tables import read_tables
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.savez(Path(folder) / "run.npz", states=np.zeros((5, 2)), actions=np.ones((4, 1)), control_hz=30.0)
        ...     read_tables(folder).control_hz
        30.0
    """
    folder = Path(folder)
    files = _files(folder)
    if not files:
        raise FileNotFoundError(f"{folder} holds no *.npz, *.csv or *.parquet files")
    archives = [file.name for file in files if file.suffix == ".npz"]
    if action_columns is not None and archives:
        raise ValueError(
            f"action_columns: not an option for NumPy archives ({archives[0]}), whose actions are the entry"
            f" {' or '.join(map(repr, ACTIONS))}"
        )
    problems: list[str] = []
    tables: dict[Path, _Table] = {}
    for file in files:
        try:
            tables[file] = _READERS[file.suffix](file, action_columns)
        except _UNREADABLE as error:
            problems.append(f"{file}: {error or type(error).__name__}")
    names = [_common_names(tables, kind, problems) for kind in ("state", "action")]
    if control_hz is None and not problems:
        control_hz = _common_rate([table.rate for table in tables.values() if table.rate], problems)
    if problems:
        raise DataError(folder, problems)
    found = [
        (frames, steps, file.name if len(table.trajectories) == 1 else f"{file.name}[{index}]")
        for file, table in tables.items()
        for index, (frames, steps) in enumerate(table.trajectories)
    ]
    states, actions, sources = zip(*found, strict=True)
    return make_recordings(
        states,
        actions,
        action_dim=action_dim,
        state_names=names[0],
        action_names=names[1],
        sources=sources,
        control_hz=control_hz,
        source=str(folder),
        skipped=[name for table in tables.values() for name in table.unread],
    )


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.glob("*") if path.suffix in _READERS and path.is_file())


def _read_npz(file: Path, action_columns: Sequence[str] | None) -> _Table:
    with np.load(file, allow_pickle=False) as archive:
        entries = {name: archive[name] for name in archive.files}
    key = next((name for name in STATES if name in entries), None)
    if key is None:
        raise ValueError(
            f"has no states: wanted one of {', '.join(STATES)}, it holds {', '.join(entries) or 'nothing'}"
        )
    acting = next((name for name in ACTIONS if name in entries), None)
    names = [
        [str(name) for name in entries[entry]] if entry in entries else None
        for entry in ("state_names", "action_names")
    ]
    rate = float(entries["control_hz"]) if "control_hz" in entries else None
    read = {key, acting, "state_names", "action_names", "control_hz"}
    steps = None if acting is None else entries[acting]
    return _Table([(entries[key], steps)], names[0], names[1], rate, [name for name in entries if name not in read])


def _read_csv(file: Path, action_columns: Sequence[str] | None) -> _Table:
    with file.open(newline="", encoding="utf-8-sig") as stream:
        rows = list(csv.reader(stream))
    if len(rows) < 2:
        raise ValueError("wanted a header and a row per frame")
    header = [name.strip() for name in rows[0]]
    for number, name in enumerate(header):
        if not name:
            raise ValueError(f"column {number + 1} has no name; is it the index of the rows? leave it out")
        if header.index(name) != number:
            raise ValueError(f"columns {header.index(name) + 1} and {number + 1} are both named {name!r}")
    values = np.empty((len(rows) - 1, len(header)))
    for number, row in enumerate(rows[1:]):
        if len(row) != len(header):
            raise ValueError(f"row {number + 2} has {len(row)} fields, the header has {len(header)}")
        for column, text in enumerate(row):
            try:
                values[number, column] = float(text) if text.strip() else np.nan
            except ValueError:
                raise ValueError(f"row {number + 2}, column {header[column]!r}: {text!r} is no number") from None
    return _split({name: values[:, index] for index, name in enumerate(header)}, action_columns, [])


def _read_parquet(file: Path, action_columns: Sequence[str] | None) -> _Table:
    pyarrow = import_pyarrow()
    try:
        table = pyarrow.parquet.read_table(file)
    except pyarrow.ArrowException as error:
        raise ValueError(f"cannot be read: {str(error).splitlines()[0]}") from error
    columns: dict[str, np.ndarray] = {}
    unread = []
    for name in table.column_names:
        values = table[name]
        if pyarrow.types.is_boolean(values.type):
            values = values.cast(pyarrow.int8())
        kind = number_type(values.type)
        if kind is None:  # text, dates, pictures
            unread.append(name)
            continue
        block = numbers(values.cast(kind), name)
        alone = not pyarrow.types.is_list(kind)
        columns |= {name if alone else f"{name}_{index}": block[:, index] for index in range(block.shape[1])}
    return _split(columns, action_columns, unread)


_READERS = {".npz": _read_npz, ".csv": _read_csv, ".parquet": _read_parquet}


def _split(columns: Mapping[str, np.ndarray], action_columns: Sequence[str] | None, unread: list[str]) -> _Table:
    """Trajectories of a table with named columns."""
    acting = [name for name in columns if name == "action" or name.startswith(("action_", "action."))]
    if action_columns is not None:
        acting = [name for name in action_columns if lookup(columns, name, "action column") is not None]
    time = next((name for name in TIMES if name in columns), None)
    episode = next((name for name in EPISODES if name in columns), None)
    apart = {time, episode, *_COUNTERS, *acting}
    observed = [name for name in columns if name not in apart]
    if not observed:
        raise ValueError(f"has no state columns, only {', '.join(columns)}")
    frames = np.stack([columns[name] for name in observed], 1)
    steps = np.stack([columns[name] for name in acting], 1) if acting else None
    number = columns[episode] if episode else np.zeros(len(frames))
    starts = np.flatnonzero(np.r_[True, np.diff(number) != 0])
    pieces = [slice(start, end) for start, end in zip(starts, [*starts[1:], len(frames)], strict=True)]
    found = [(frames[piece], None if steps is None else steps[piece]) for piece in pieces]
    rate = _rate([columns[time][piece] for piece in pieces]) if time else None
    return _Table(found, observed, acting or None, rate, unread)


def _rate(times: Sequence[np.ndarray]) -> float:
    steps = np.concatenate([np.diff(stamps) for stamps in times])
    if not len(steps) or not (steps > 0).all():
        raise ValueError("time stamps do not increase")
    middle = np.median(steps)
    if np.abs(steps - middle).max() > _UNEVEN * middle:
        raise ValueError(
            f"frames are {steps.min():.4g} to {steps.max():.4g} s apart; resample them to a fixed rate first, or pass"
            " control_hz"
        )
    return float(1 / middle)


def _common_rate(rates: Sequence[float], problems: list[str]) -> float | None:
    if not rates:
        problems.append("no file has time stamps (a column 'timestamp' in seconds): pass control_hz")
        return None
    if max(rates) > (1 + _UNEVEN) * min(rates):
        problems.append(
            f"the files have {min(rates):.4g} to {max(rates):.4g} frames per second: resample them, or pass control_hz"
        )
    return float(np.median(rates))


def _common_names(tables: Mapping[Path, _Table], kind: str, problems: list[str]) -> list[str] | None:
    """Names of the state or action columns that all files with any have."""
    every = {file: table.state_names if kind == "state" else table.action_names for file, table in tables.items()}
    named = {file: names for file, names in every.items() if names is not None}
    if not named:
        return None
    first, wanted = next(iter(named.items()))
    problems += [
        f"{file}: {kind} columns are {', '.join(names)}; those of {first.name} are {', '.join(wanted)}"
        for file, names in named.items()
        if names != wanted
    ]
    return wanted
