# This source code is licensed under the MIT license found in the LICENSE file.
"""The files of a LeRobot data set: from parquet to the rows of single episodes, with pyarrow alone.

::

    meta/info.json                     features with their names, fps, splits, totals   (meta_data/info.json in v1.x)
    meta/episodes.jsonl                number of rows of every episode                  (v2.x)
    meta/episodes/**/*.parquet         the same                                         (v3.0)
    meta_data/episode_data_index.safetensors                                            (v1.x)
    data/**/*.parquet                  one row per frame: observation.state, action, episode_index, frame_index

How the rows are spread over files differs between the versions (all in one, one file per episode, many episodes per
file) and does not matter here: rows are put together by ``episode_index`` and ``frame_index``.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.d3il.conversion import RawFolderError

OBSERVATIONS = ("observation.state", "observation.environment_state")  # side by side; the second one is optional
ACTION, EPISODE, FRAME = "action", "episode_index", "frame_index"
_INFO = ("meta/info.json", "meta_data/info.json")


@dataclass(frozen=True)
class LeRobotEpisode:
    """One episode of ``T`` rows.

    Args:
        number (int): its ``episode_index``.
        file (Path): where its first row lies.
        observation (np.ndarray): float64 ``[T, d]``.
        action (np.ndarray): float64 ``[T, a]``.

    Examples:
        >>> from pathlib import Path
        >>> import numpy as np
        >>> from torchrl_koap.data.lerobot.files import LeRobotEpisode
        >>> LeRobotEpisode(0, Path("data.parquet"), np.zeros((50, 6)), np.zeros((50, 6))).observation.shape
        (50, 6)
    """

    number: int
    file: Path
    observation: np.ndarray
    action: np.ndarray


@dataclass(frozen=True)
class LeRobotFolder:
    """What a folder holds.

    Args:
        info (mapping): its ``info.json``.
        widths (dict): columns of each observation feature, in the order in which they lie side by side.
        episodes (list of LeRobotEpisode): the sound ones, in the order of their numbers.
        problems (list of str): what is wrong with the others.

    Examples:
        >>> from torchrl_koap.data.lerobot.files import read_lerobot_folder
        >>> read_lerobot_folder("recordings/so101").widths  # doctest: +SKIP
        {'observation.state': 6}
    """

    info: Mapping[str, Any]
    widths: dict[str, int]
    episodes: list[LeRobotEpisode]
    problems: list[str]


def is_lerobot(folder: str | Path) -> bool:
    """Whether a folder is a LeRobot data set (``meta/info.json``, or ``meta_data/info.json`` of v1.x)."""
    return any((Path(folder) / info).is_file() for info in _INFO)


def find_lerobot_files(root: str | Path) -> list[Path]:
    """All files of a data set that are looked at, in the order of their names.

    Raises:
        FileNotFoundError: if there is no ``info.json`` or no parquet file.
    """
    root = Path(root).expanduser()
    if not is_lerobot(root):
        raise FileNotFoundError(f"no LeRobot data set in {root}: it has none of {', '.join(_INFO)}")
    rows = _parquet_files(root)
    if not rows:
        raise FileNotFoundError(f"no *.parquet below {root / 'data'}")
    described = [root / "meta/episodes.jsonl", *(root / "meta/episodes").rglob("*.parquet")]
    described += [root / info for info in _INFO] + [root / "meta_data/episode_data_index.safetensors"]
    return sorted(file for file in described if file.is_file()) + rows


def read_lerobot_folder(
    root: str | Path, *, features: Sequence[str] | None = None, labels_needed: bool = True
) -> LeRobotFolder:
    """Reads observations and actions of all episodes.

    Args:
        root (str or Path): folder of the data set.

    Keyword Args:
        features (sequence of str, optional): columns that are laid side by side as the observation. Default:
            ``observation.state`` and, if there, ``observation.environment_state``.
        labels_needed (bool): every row must have an action. If not, rows whose action is empty or NaN, and all rows
            where there is no column ``action``, have NaN. Defaults to True.

    Raises:
        RawFolderError: with the problems of all files: unreadable ones, missing columns, values that are not finite.
        ValueError: if the descriptions cannot be read.
        FileNotFoundError: if the folder is no LeRobot data set.
        RuntimeError: if pyarrow is not installed (extra ``lerobot``).
    """
    root = Path(root).expanduser()
    find_lerobot_files(root)
    info = read_info(root)
    rows = _read_rows(root, features, None if labels_needed else _action_width(info))
    episodes, problems = _episodes(rows, _expected_lengths(root, info))
    return LeRobotFolder(info, rows["widths"], episodes, problems)


def given_names(feature: Mapping[str, Any], width: int) -> list[str] | None:
    """Names that ``info.json`` gives to a feature's columns, None if it gives none, or not as many.

    Args:
        feature (mapping): its entry in ``info.json``; names are a list, a list in a list, ``{"motors": [...]}`` or
            ``{"pan": 0, ...}``.
        width (int): number of its columns.

    Examples:
        >>> from torchrl_koap.data.lerobot.files import given_names
        >>> given_names({"names": {"motors": ["pan", "lift"]}}, 2)
        ['pan', 'lift']
    """
    given = feature.get("names")
    if isinstance(given, Mapping):
        listed = next(iter(given.values()), None)
        given = listed if isinstance(listed, list) else sorted(given, key=given.get)
    if isinstance(given, list) and len(given) == 1 and isinstance(given[0], list):
        given = given[0]
    usable = isinstance(given, list) and len(given) == width and all(isinstance(name, str) for name in given)
    return given if usable else None


def _parquet_files(root: Path) -> list[Path]:
    return sorted((root / "data").rglob("*.parquet"))


def _pyarrow():
    if importlib.util.find_spec("pyarrow") is None:
        raise RuntimeError("LeRobot data sets are read with an extra: pip install 'torchrl_koap[lerobot]'")
    import pyarrow
    import pyarrow.parquet

    return pyarrow


def read_info(root: str | Path) -> dict[str, Any]:
    """Reads the description of a data set.

    Raises:
        FileNotFoundError: if the folder is no LeRobot data set.
        ValueError: if the description is no JSON dictionary.
    """
    find_lerobot_files(root)
    file = next(Path(root) / info for info in _INFO if (Path(root) / info).is_file())
    try:
        info = json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(f"{file} is no JSON: {error}") from error
    if not isinstance(info, dict):
        raise ValueError(f"{file} must hold a dictionary, got {type(info).__name__}")
    return info


def _action_width(info: Mapping[str, Any]) -> int:
    """Number of action columns that ``info.json`` announces, 0 if it is silent."""
    shape = ((info.get("features") or {}).get(ACTION) or {}).get("shape") or [0]
    return int(shape[0]) if isinstance(shape, list) and isinstance(shape[0], int) else 0


def _read_rows(root: Path, chosen: Sequence[str] | None, optional_width: int | None) -> dict[str, Any]:
    """The rows of all files one after the other: ``observation [N, d]``, ``action [N, a]``, numbers, and files.

    ``optional_width`` is the width of actions that may be missing, None if none may.
    """
    pyarrow, problems = _pyarrow(), []
    tables: list[tuple[Path, list[str], dict[str, np.ndarray]]] = []
    needed = [OBSERVATIONS[0]] if chosen is None else list(chosen)
    for file in _parquet_files(root):
        try:
            present = pyarrow.parquet.read_schema(file).names
            features = [name for name in OBSERVATIONS if name in present] if chosen is None else list(chosen)
            labels = [ACTION] if optional_width is None or ACTION in present else []
            missing = [name for name in (*needed, *labels, EPISODE, FRAME) if name not in present]
            problems += [f"{file}: missing column {name!r}; the file has {', '.join(present)}" for name in missing]
            if missing:
                continue
            table = pyarrow.parquet.read_table(file, columns=[*features, *labels, EPISODE, FRAME])
        except (pyarrow.ArrowException, OSError) as error:
            problems.append(f"{file}: cannot be read: {str(error).splitlines()[0]}")
            continue
        found = {
            name: _column(table, name, gap_width=optional_width if name == ACTION else None)
            for name in table.column_names
        }
        if not labels:
            found[ACTION] = np.full((len(table), optional_width), np.nan)
        problems += [f"{file}: column {name!r} {fault}" for name, fault in found.items() if isinstance(fault, str)]
        columns = {name: column for name, column in found.items() if not isinstance(column, str)}
        if len(columns) == len(found):
            tables.append((file, features, columns))
    widths = [{name: columns[name].shape[1] for name in (*features, ACTION)} for _, features, columns in tables]
    for (file, _, _), width in zip(tables, widths, strict=True):
        if width != widths[0]:
            problems.append(f"{file}: its columns have widths {width}, those of {tables[0][0].name} {widths[0]}")
    if not problems and not widths[0][ACTION]:
        problems.append("no file has actions, and info.json does not say how many columns an action has")
    if problems:
        raise RawFolderError(root, problems)
    return {
        "widths": {name: width for name, width in widths[0].items() if name != ACTION},
        "observation": np.concatenate([np.concatenate([c[name] for name in f], 1) for _, f, c in tables]),
        ACTION: np.concatenate([columns[ACTION] for _, _, columns in tables]),
        EPISODE: np.concatenate([columns[EPISODE][:, 0] for _, _, columns in tables]).astype(np.int64),
        FRAME: np.concatenate([columns[FRAME][:, 0] for _, _, columns in tables]).astype(np.int64),
        "file": [file for file, _, columns in tables for _ in range(len(columns[ACTION]))],
    }


def _column(table, name: str, *, gap_width: int | None = None) -> np.ndarray | str:
    """A column as float64 ``[rows, width]``, or what is wrong with it; with ``gap_width`` rows may be empty or NaN."""
    types, column = _pyarrow().types, table.column(name)
    kind, chunks = column.type, column.chunks
    fixed, nested = types.is_fixed_size_list(kind), types.is_list(kind) or types.is_large_list(kind)
    inner = kind.value_type if fixed or nested else kind
    if not (types.is_floating(inner) or types.is_integer(inner)):
        return f"must hold numbers or lists of numbers, got {kind}"
    parts = [chunk.flatten() if fixed or nested else chunk for chunk in chunks]
    if column.null_count or any(part.null_count for part in parts):
        return "has empty entries" if gap_width is None else _with_gaps(column.to_pylist(), gap_width)
    if not len(column):
        return "has no rows"
    sizes = {kind.list_size} if fixed else {1}
    if nested:
        sizes = {size for chunk in chunks for size in np.unique(np.diff(chunk.offsets.to_numpy())).tolist()}
    if len(sizes) != 1 or 0 in sizes:
        return f"has rows of {' and '.join(map(str, sorted(sizes)))} numbers, wanted the same number in all"
    values = np.concatenate([part.to_numpy(zero_copy_only=False) for part in parts])
    values = values.astype(np.float64).reshape(-1, *sizes)
    bad = ~np.isfinite(values).all(1) if gap_width is None else np.isinf(values).any(1)
    if bad.any():
        return f"is NaN or infinite in {int(bad.sum())} rows, first in row {int(np.flatnonzero(bad)[0])}"
    return values


def _with_gaps(rows: list[Any], announced: int) -> np.ndarray | str:
    """Rows of which some are empty, as NaN; ``announced`` is their width if all are."""
    listed = [[row] if isinstance(row, (int, float)) else row for row in rows]
    widths = {len(row) for row in listed if row is not None}
    if len(widths) > 1:
        return f"has rows of {' and '.join(map(str, sorted(widths)))} numbers, wanted the same number in all"
    width = next(iter(widths), announced or 1)
    return np.array([[np.nan] * width if row is None else row for row in listed], dtype=np.float64)


def _expected_lengths(root: Path, info: Mapping) -> dict[int, int | None]:
    """Rows of every episode as the description has it, None where it only says that there is such an episode."""
    listed, tables = root / "meta/episodes.jsonl", sorted((root / "meta/episodes").rglob("*.parquet"))
    index = root / "meta_data/episode_data_index.safetensors"
    try:
        if listed.is_file():
            entries = [json.loads(line) for line in listed.read_text().splitlines() if line.strip()]
            return {int(entry[EPISODE]): int(entry["length"]) for entry in entries}
        if tables:
            read = _pyarrow().parquet.read_table
            entries = [row for file in tables for row in read(file, columns=[EPISODE, "length"]).to_pylist()]
            return {int(entry[EPISODE]): int(entry["length"]) for entry in entries}
        if index.is_file():
            from safetensors.numpy import load_file

            ends = load_file(index)
            return {number: int(rows) for number, rows in enumerate(ends["to"] - ends["from"])}
        return dict.fromkeys(range(int(info.get("total_episodes") or 0)))
    except Exception as error:  # safetensors has an error class of its own
        raise ValueError(f"{root}: the list of its episodes cannot be read: {error!r}") from error


def _episodes(rows: Mapping, expected: Mapping[int, int | None]) -> tuple[list[LeRobotEpisode], list[str]]:
    order = np.lexsort((rows[FRAME], rows[EPISODE]))
    numbers, starts = np.unique(rows[EPISODE][order], return_index=True)
    missing = sorted(expected.keys() - {*numbers.tolist()})
    problems = [f"{len(missing)} episodes are missing: {', '.join(map(str, missing[:10]))}"] if missing else []
    episodes = []
    for number, index in zip(numbers.tolist(), np.split(order, starts[1:]), strict=True):
        file, length = rows["file"][index[0]], expected.get(number)
        if length is not None and length != len(index):
            problems.append(f"{file}: episode {number} has {len(index)} rows, its description says {length}")
        elif not np.array_equal(rows[FRAME][index], np.arange(len(index))):
            problems.append(f"{file}: column {FRAME!r} of episode {number} must count 0, 1, 2, ...")
        elif len(index) < 2:
            problems.append(f"{file}: episode {number} is too short: 1 row, at least 2 are needed")
        else:
            episodes.append(LeRobotEpisode(number, file, rows["observation"][index], rows[ACTION][index]))
    return episodes, problems
