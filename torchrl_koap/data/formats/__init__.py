# This source code is licensed under the MIT license found in the LICENSE file.
"""Reads and writes recordings of a user's robot, in the formats that :data:`FORMATS` lists."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_koap import keys
from torchrl_koap.data.formats.frames import stored_clips
from torchrl_koap.data.formats.lerobot import INFO, read_lerobot
from torchrl_koap.data.formats.minari import PREFIX, read_minari
from torchrl_koap.data.formats.recordings import Recordings, make_recordings
from torchrl_koap.data.formats.robomimic import hdf5_files, read_robomimic
from torchrl_koap.data.formats.tables import read_tables, table_files
from torchrl_koap.data.formats.writers import write_lerobot, write_npz
from torchrl_koap.data.ted import load_ted, source_names, stored_folder
from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.files import DataError, option, read_json
from torchrl_koap.lookup import lookup

__all__ = ["FORMATS", "Format", "Recordings", "make_recordings", "read_recordings", "write_recordings"]


@dataclass(frozen=True)
class Format:
    """How recordings in one format are recognised, read and written."""

    what: str  # description for messages
    matches: Callable[[str], bool]  # checks whether a source has this format
    read: Callable[..., Recordings]  # from a source and ``options``
    options: tuple[str, ...] = ()  # options of read_recordings that it takes
    write: Callable[[Recordings, Path], None] | None = None  # into a new folder; None: cannot be written


def _read_stored(source: str) -> Recordings:
    """Reads all observation columns, including commands, and all labels of a data set of this library."""
    folder = stored_folder(source)
    data, task = load_ted(folder)
    lengths = trajectory_lengths(data).tolist()
    origin, added = (torch.tensor(part, dtype=torch.float64) for part in task.origins or (0.0, 0.0))
    before, after = (data[key].double() + origin for key in (keys.OBSERVATION, keys.NEXT_OBSERVATION))
    actions = torch.where(data[keys.HAS_ACTION], data[keys.ACTION].double() + added, torch.nan)
    pairs = zip(before.split(lengths), after.split(lengths), strict=True)
    return make_recordings(
        [torch.cat([frames, following[-1:]]) for frames, following in pairs],
        actions.split(lengths),
        state_names=task.observation_names,
        action_names=task.action_names,
        sources=source_names(folder) or np.arange(len(lengths)).astype(str),
        control_hz=task.control_hz,
        skipped=["units, kinds of actions and roles of columns"],  # other formats do not hold them
        cameras=stored_clips(folder),
        source=source,
    )


# files that are no recordings -> advice
_ELSEWHERE = {
    "*.npy": "*.npy files are not read: save each recording with np.savez(file, states=..., actions=...)",
    **dict.fromkeys(
        ("*.pkl", "*.pickle", "*.p"),
        "pickles are not read: save the arrays of each recording, or of all with the ends of their"
        " episodes, by np.savez(file, observations=..., actions=..., timeouts=...)",
    ),
    "*.tsv": "it holds *.tsv files: rename them to *.csv",
    **dict.fromkeys(
        (f"{below}*.{kind}" for below in ("*/", "*/*/") for kind in ("npz", "csv", "parquet")),
        "folders below it hold tables: name one of them",
    ),
    "*/meta/info.json": "folders below it hold LeRobot data sets: name one of them",
    **dict.fromkeys(("*.gz", "*.zip", "*.tar", "*.xz"), "it holds packed files: unpack them"),
}
# options of all formats except "ted"
COMMON = ("control_hz", "resample", "action_kind", "action_dim", "state_columns", "drop_columns")

FORMATS = {
    "minari": Format(
        f"{PREFIX}NAME, a Minari data set on this machine",
        lambda source: source.startswith(PREFIX),
        read_minari,
        COMMON,
    ),
    "ted": Format("a data set of this library", lambda source: stored_folder(source) is not None, _read_stored),
    "robomimic": Format(
        "an HDF5 file in robomimic's layout or ALOHA's, or a folder of them (*.hdf5)",
        lambda source: bool(hdf5_files(source)) and not table_files(source),
        read_robomimic,
        ("observations", *COMMON),
    ),
    "lerobot": Format(
        "a LeRobot data set (meta/info.json)",
        lambda source: (Path(source) / INFO).is_file(),
        read_lerobot,
        ("observations", "episodes", *COMMON),
        write_lerobot,
    ),
    "npz": Format(
        "a table, or a folder of tables (*.npz, *.csv, *.parquet), a trajectory each",
        lambda source: bool(table_files(source)),
        read_tables,
        ("action_columns", *COMMON),
        write_npz,
    ),
}


def read_recordings(
    source: str | Path,
    *,
    control_hz: float | None = None,
    resample: float | None = None,
    action_kind: str | Sequence[str] | None = None,
    observations: Sequence[str] = (),
    episodes: Sequence[int] = (),
    action_columns: Sequence[str] = (),
    action_dim: int | None = None,
    state_columns: Sequence[str] = (),
    drop_columns: Sequence[str] = (),
) -> Recordings:
    """Reads recordings of any robot; the source determines which of the :data:`FORMATS` is used.

    Args:
        source (str or Path): a folder of tables, a LeRobot data set, an HDF5 file or a folder of them, ``minari:NAME``,
            or a data set of this library.

    Keyword Args:
        control_hz (float, optional): frames per second; overrides time stamps. Default: the rate of the source.
        resample (float, optional): wanted frames per second, also for irregular time stamps. States are interpolated;
            switches and leaps take the nearest frame; actions are held or summed.
        action_kind (str, or sequence of str): kind of the actions, needed for ``resample``. ``"change"`` over one frame
            is summed; ``"velocity"``, ``"absolute"`` and ``"raw"`` (torques) are held.
        observations (sequence of str): features of a LeRobot data set, or entries of an HDF5 file, that make up the
            state. Default: all that are not images.
        episodes (sequence of int): episodes of a LeRobot data set to read. Default: all.
        action_columns (sequence of str): action columns of CSV and parquet tables, if their names do not begin with
            ``action``.
        action_dim (int, optional): number of action columns, if no trajectory has actions.
        state_columns (sequence of str): columns that make up the state, in this order. Default: all except clocks,
            counters, rewards and flags of episodes, which are listed in ``skipped``.
        drop_columns (sequence of str): state and action columns to leave out.

    Returns:
        Recordings: trajectories with the names of their columns.

    Raises:
        DataError: listing all faults of the recordings.
        FileNotFoundError: if there is no such source.
        ValueError: if the source has none of the formats, or an option does not apply to its format.

    Examples:
        >>> from torchrl_koap.data import read_recordings
        >>> read_recordings("/data/so100_pick")  # doctest: +SKIP
    """
    asked: dict[str, Any] = {"control_hz": control_hz, "resample": resample, "action_kind": action_kind}
    asked |= {"observations": list(observations), "episodes": list(episodes)}
    asked |= {"action_columns": list(action_columns), "action_dim": action_dim}
    asked |= {"state_columns": list(state_columns), "drop_columns": list(drop_columns)}
    given = {name: value for name, value in asked.items() if value not in (None, [])}
    source = os.path.expanduser(source)
    name = find_format(source)
    if name is None and not Path(source).exists():
        raise FileNotFoundError(f"{source} does not exist")
    if name is None:
        here = Path(source)
        holds = Path(here.name).match if here.is_file() else lambda ending: any(here.glob(ending))
        said = [*dict.fromkeys(hint for ending, hint in _ELSEWHERE.items() if holds(ending))]
        said.append("there are readers for " + ", ".join(form.what for form in FORMATS.values()))
        raise ValueError(f"{source} holds no recordings that can be read; {'; '.join(said)}")
    form = FORMATS[name]
    unfit = [name for name in given if name not in form.options]
    if unfit:
        raise ValueError(f"{', '.join(map(option, unfit))}: not an option for {form.what}")
    found = form.read(str(source), **given)
    others = [f"{other.what} (another format)" for other in FORMATS.values() if other != form and other.matches(source)]
    return replace(found, skipped=(*found.skipped, *others))


def find_format(source: str | Path) -> str | None:
    """Returns the name of a source's format among :data:`FORMATS`, or None; raises a DataError for a run."""
    config = Path(source) / "config.json"
    if config.is_file() and config.with_name("metrics.csv").is_file() and "dataset" in (run := read_json(config)):
        raise DataError(source, f"it is a run of `koap train`, which was trained on the data set {run['dataset']}")
    return next((name for name, form in FORMATS.items() if form.matches(str(source))), None)


def writer_of(name: str, out: str | Path) -> Callable[[Recordings, Path], None]:
    """Returns the function that writes recordings as ``"npz"`` or ``"lerobot"``.

    Raises:
        ValueError: if the format cannot be written; the message suggests the nearest.
        FileExistsError: if the folder ``out`` exists.
    """
    write = lookup({key: form.write for key, form in FORMATS.items() if form.write is not None}, name, "format")
    if Path(out).expanduser().exists():
        raise FileExistsError(f"{out} exists already; choose another folder (--out)")
    return write


def write_recordings(recordings: Recordings, out: str | Path, name: str) -> Path:
    """Writes recordings into a new folder by :func:`writer_of` and returns the folder.

    Raises:
        ValueError, FileExistsError: as :func:`writer_of`.
        DataError: if the format needs a rate, and none is known.
        RuntimeError: if the format's package is not installed; the message names the extra.
    """
    out = Path(out).expanduser()
    writer_of(name, out)(recordings, out)
    return out
