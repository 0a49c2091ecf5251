# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads LeRobot data sets (formats 2.x and 3.0) of any robot; needs only pyarrow.

::

    meta/info.json                     features with their names, fps, totals
    meta/episodes.jsonl                number of rows of every episode                  (2.x)
    meta/episodes/**/*.parquet         number of rows of every episode                  (3.0)
    data/**/*.parquet                  one row per frame: observation.state, action, episode_index, frame_index

Rows are assembled by ``episode_index`` and ``frame_index``, whether a file holds one episode or many.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_koap.data.formats.clocks import declared_rate
from torchrl_koap.data.formats.columns import assemble
from torchrl_koap.data.formats.frames import lerobot_clips
from torchrl_koap.data.formats.kinds import kind_of
from torchrl_koap.data.formats.parquet import import_pyarrow, number_type, numbers
from torchrl_koap.data.formats.pieces import Piece
from torchrl_koap.data.formats.recordings import Recordings
from torchrl_koap.files import DataError, check_file, gathered, option, read_bytes, read_json, refuse, some

PREFIX, STATE, ACTION = "observation.", "observation.state", "action"
SURROUNDINGS = "observation.environment_state"  # its column names get the prefix "environment_state_"
EPISODE, FRAME, TIME = "episode_index", "frame_index", "timestamp"
IMAGES = ("image", "video")
INFO = "meta/info.json"
_LARGEST = 1 << 40  # bytes of a data file


def read_lerobot(
    root: str | Path, *, observations: Sequence[str] | None = None, episodes: Sequence[int] = (), **options: Any
) -> Recordings:
    """Reads a data set in format 2.x or 3.0, with its rate ``fps``; rows without actions have no label.

    The options are those of :func:`~torchrl_koap.data.formats.columns.assemble`.
    """
    info = _read_info(root)
    known = info["features"]
    observed = [name for name in known if name.startswith(PREFIX)]
    cameras = _camera_names([name for name in observed if known[name].get("dtype") in IMAGES])
    images = [name for name in observed if name in cameras or len(known[name].get("shape") or [1]) > 1]
    usable = [name for name in observed if name not in images and known[name].get("dtype") != "string"]
    chosen = usable if observations is None else list(observations)
    problems = [
        f"feature {name!r} is an image ({known[name].get('dtype')}) and cannot be part of the state: embed it first"
        if name in cameras
        else f"feature {name!r} has shape {known[name]['shape']} and cannot be part of the state, wanted a vector"
        for name in chosen
        if name in images
    ]
    problems += [
        f"info.json has no feature {name!r}; it has {', '.join(observed) or 'no observations'}"
        for name in chosen
        if name not in known
    ]
    if not chosen:
        cure = f"name those of the state in {option('observations')}"
        problems.append(f"no feature {PREFIX}* holds numbers: {cure}; there are {', '.join(known) or 'none'}")
    refuse(root, problems)
    flags = [name for name in known if name not in observed and kind_of(name)[0] in ("start", "end")]
    rows, undescribed = _read_rows(Path(root), info, chosen, flags, episodes)
    if not rows:
        raise DataError(root, "there are no trajectories")
    first, width = next(iter(rows.values())), _announced(info) or options.get("action_dim")
    wide = {name: (first[name].shape[1], _announced(info, name)) for name in (*chosen, ACTION) if name in first}
    problems = [
        f"column {name!r} has {there} numbers, info.json says {said}"
        for name, (there, said) in wide.items()
        if said not in (0, there)
    ]
    refuse(root, problems)
    if ACTION not in first and not width:
        fault = f"no file has a column {ACTION!r}, and info.json does not give the number of action columns"
        raise DataError(root, f"{fault}: pass {option('action_dim')}")
    names = [label for name in chosen for label in _names(known[name], name, first[name].shape[1])]
    beside = [name for name in (TIME, *flags) if name in first]
    if len({*names, *beside}) < len(names) + len(beside):  # two features with the same names of columns
        names = [label for name in chosen for label in _names({}, name, first[name].shape[1])]
    twice = sorted(name for name in {*names} if [*names, *beside].count(name) > 1)
    if twice:
        raise DataError(
            root, f"two features have a column {some(twice)}: name those to read in {option('observations')}"
        )
    acting = _names(known.get(ACTION) or {}, ACTION, first[ACTION].shape[1] if ACTION in first else width)
    clips, pieces = lerobot_clips(root, info, cameras, rows), []
    unseen = [name for name in images if cameras.get(name) not in clips[min(rows)]]
    rate = declared_rate(info.get("fps"))
    why = "its videos are not here" if rate is not None else "info.json holds no fps, by which its frames are found"
    absent = [f"{name} ({why})" if name in cameras else name for name in unseen]
    for number, columns in rows.items():
        states = dict(zip(names, np.concatenate([columns[name] for name in chosen], 1).T, strict=True))
        steps = dict(zip(acting, columns[ACTION].T, strict=True)) if ACTION in columns else None
        states |= {name: columns[name][:, 0] for name in beside}
        pieces.append(Piece(f"episode {number}", states, steps, cameras=clips[number]))
    if ACTION not in first:
        options = {"action_dim": width} | options
        absent += [f"{ACTION} (info.json lists it, no file has it)"] if ACTION in known else []
    read = (*chosen, *images, *flags, ACTION, TIME, EPISODE, FRAME, "index", "task_index")
    unread = [name for name in known if name not in read]
    if isinstance(tasks := info.get("total_tasks"), int) and tasks > 1:
        unread.append(f"task_index ({tasks} tasks become one: name the {option('episodes')} of one)")
    unread += [f"{name} (info.json does not list it)" for name in undescribed if name not in (*read, *known)]
    return assemble(
        pieces,
        str(root),
        declared_hz=rate,
        action_names=acting,
        skipped=[*absent, *unread],
        no_rate="info.json holds no fps",
        **options,
    )


def _read_info(root: str | Path) -> dict[str, Any]:
    """Reads the description of a data set; raises a DataError if it is invalid."""
    file = Path(root) / INFO
    info = read_json(file)
    features = info.get("features") or {}
    if not isinstance(features, dict) or not all(isinstance(feature, dict) for feature in features.values()):
        raise DataError(file, "'features' must be a dictionary of dictionaries")
    odd = [name for name, feature in features.items() if not isinstance(feature.get("shape") or [], list)]
    if odd:
        raise DataError(file, f"'shape' of {some(odd)} must be a list of numbers")
    if (version := str(info.get("codebase_version", "v3.0")))[:3] not in ("v2.", "v3."):
        raise DataError(file, f"its codebase_version is {version}, wanted 2.x or 3.x")
    return info | {"features": features}


def _read_rows(
    root: Path, info: Mapping[str, Any], features: Sequence[str], flags: Sequence[str], episodes: Sequence[int]
) -> tuple[dict[int, dict[str, Any]], list[str]]:
    """Reads columns of numbers, with actions and flags if present, of every episode by its number.

    They are float64 ``[T, d]``, NaN where a row is empty; ``frame_index`` is ``[T]``, ``file`` their file. The second
    value lists the columns that are not read.
    """
    table, unread = _read_table(root, (*features, EPISODE, FRAME), (ACTION, TIME, *flags))
    files, problems = table["__filename"].to_pylist(), []
    columns: dict[str, Any] = {}
    for name in table.column_names:
        if name != "__filename":
            announced = _announced(info) if name == ACTION else 1
            try:
                columns[name] = numbers(table[name], name, announced=announced, files=files)
            except ValueError as error:
                problems.append(str(error))
    if EPISODE in columns and (odd := np.flatnonzero(columns[EPISODE][:, 0] % 1 != 0)).size:
        value = columns[EPISODE][odd[0], 0]
        got = "an empty row" if np.isnan(value) else f"{value:g}"
        problems.append(f"{files[odd[0]]}: column {EPISODE!r} must hold whole numbers, got {got}")
    refuse(root, problems)
    episode, frame = (columns.pop(name)[:, 0] for name in (EPISODE, FRAME))
    found, starts, lengths = np.unique(episode.astype(int), return_index=True, return_counts=True)
    ends, expected = starts + lengths, _expected_lengths(root, info)
    missing = sorted((set(episodes) or expected.keys()) - {*found.tolist()})
    if missing:
        cure = f"name in {option('episodes')} those to read: {some(found)}"
        problems = [f"{len(missing)} episodes are missing: {some(missing)}; {cure}"]
    rows: dict[int, dict[str, Any]] = {}
    unlisted = [number for number in found.tolist() if expected and not episodes and number not in expected]
    if unlisted:
        said = f"the description of episodes lacks {some(unlisted)}, which have rows"
        problems.append(f"{said}: name in {option('episodes')} those to read")
    for number, start, end in zip(found.tolist(), starts, ends, strict=True):
        if episodes and number not in episodes:
            continue
        wanted = expected.get(number)
        if wanted not in (None, end - start):
            problems.append(f"{files[start]}: episode {number} has {end - start} rows, its description says {wanted}")
        elif not np.array_equal(frame[start:end], np.arange(end - start)):
            problems.append(f"{files[start]}: column {FRAME!r} of episode {number} must count 0, 1, 2, ...")
        rows[number] = {name: values[start:end] for name, values in columns.items()}
        rows[number] |= {FRAME: frame[start:end], "file": files[start]}
    refuse(root, problems)
    return rows, unread


def _read_table(root: Path, needed: Sequence[str], wanted: Sequence[str]):
    """Reads the sorted rows of all files: needed columns, wanted columns if present, and ``__filename``.

    The second value names the columns that are not read.
    """
    pyarrow = import_pyarrow()
    files = sorted((root / "data").rglob("[!.]*.parquet"))
    faults: list[tuple[str, str]] = []
    kinds: dict[str, Any] = {}
    there: dict[str, None] = {}
    if not files:
        raise FileNotFoundError(f"no *.parquet below {root / 'data'}")
    for file in files:
        try:
            check_file(file, largest=_LARGEST)
            schema = pyarrow.parquet.read_schema(file)
            there |= dict.fromkeys(schema.names)
        except (pyarrow.ArrowException, UnicodeDecodeError):
            faults.append((str(file), "it is no parquet file, or damaged"))
            continue
        except OSError as error:
            faults.append((str(file), f"it cannot be read: {error}"))
            continue
        lacking = [name for name in needed if name not in schema.names]
        faults += [(str(file), f"missing column {name!r}; it has {', '.join(schema.names)}") for name in lacking]
        if twice := [name for name in (*needed, *wanted) if schema.names.count(name) > 1]:
            faults.append((str(file), f"two columns are named {some(twice)}"))
            continue
        for name in {*needed, *wanted}.intersection(schema.names):
            got = schema.field(name).type
            kind = number_type(got)
            kinds.setdefault(name, kind)
            if kind is None:
                faults.append((str(file), f"column {name!r} must hold numbers or lists of numbers, got {got}"))
            elif kind != kinds[name]:
                faults.append((str(file), f"column {name!r} holds {got}, but {kinds[name]} in another file"))
    refuse(root, gathered(faults))
    try:
        data = pyarrow.dataset.dataset(files, schema=pyarrow.schema(list(kinds.items())), format="parquet")
        table = data.to_table(columns=[*kinds, "__filename"])
    except (pyarrow.ArrowException, OSError) as error:
        raise DataError(root, f"it cannot be read: {str(error).splitlines()[0]}") from error
    return table.sort_by([(EPISODE, "ascending"), (FRAME, "ascending")]), [name for name in there if name not in kinds]


def _expected_lengths(root: Path, info: Mapping[str, Any]) -> dict[int, int | None]:
    """Returns the number of rows of every described episode; None if only the episode's number is known."""
    listed, tables = root / "meta/episodes.jsonl", sorted((root / "meta/episodes").rglob("[!.]*.parquet"))
    try:
        if listed.is_file():
            entries = [json.loads(line) for line in read_bytes(listed).splitlines() if line.strip()]
        elif tables:
            read = import_pyarrow().parquet.read_table
            entries = [row for file in tables for row in read(file, columns=[EPISODE, "length"]).to_pylist()]
        else:
            return dict.fromkeys(range(int(info.get("total_episodes") or 0)))
        return {int(entry[EPISODE]): int(entry["length"]) for entry in entries}
    except Exception as error:  # damaged lists may raise any exception
        raise DataError(root, f"the list of its episodes cannot be read: {error!r}") from error


def _announced(info: Mapping[str, Any], feature: str = ACTION) -> int:
    """Returns the number of columns of a feature in ``info.json``, 0 if it gives none."""
    shape = (info["features"].get(feature) or {}).get("shape") or [0]
    return int(shape[0]) if isinstance(shape, list) and isinstance(shape[0], int) else 0


def _camera_names(features: Sequence[str]) -> dict[str, str]:
    """Returns the names of cameras by feature: its last part, or all behind ``observation.`` if cameras share that."""
    last = [feature.split(".")[-1] for feature in features]
    return {
        feature: name if last.count(name) == 1 else feature.removeprefix(PREFIX).replace(".", "_")
        for feature, name in zip(features, last, strict=True)
    }


def _names(feature: Mapping[str, Any], name: str, width: int) -> list[str]:
    """Returns a feature's column names: a list (in a list), ``{"left": [...], ...}``, ``{"pan": 0}``, or numbers.

    Names of another number, or that repeat, are not used.
    """
    given, short = feature.get("names"), name.removeprefix(PREFIX)
    if isinstance(given, Mapping):
        listed, counted = (all(isinstance(part, kind) for part in given.values()) for kind in (list, int))
        given = sum(given.values(), []) if listed else sorted(given, key=given.get) if counted else None
    if isinstance(given, list) and len(given) == 1 and isinstance(given[0], list):
        given = given[0]
    named = isinstance(given, list) and len(given) == width and all(isinstance(label, str) for label in given)
    if named and len(set(given)) == width:
        return given if name != SURROUNDINGS else [f"{short}_{label}" for label in given]
    return [short] if width == 1 else [f"{short}_{index}" for index in range(width)]
