# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings from wherever they lie: the format of a folder, file or name decides who reads it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torchrl_koap.data.lerobot.any_robot import read_lerobot_recordings
from torchrl_koap.data.lerobot.files import is_lerobot
from torchrl_koap.data.recordings import Recordings, read_minari, read_robomimic, read_tables
from torchrl_koap.data.recordings.minari import PREFIX
from torchrl_koap.data.recordings.robomimic import is_hdf5
from torchrl_koap.data.recordings.tables import is_table_folder

FORMATS = (
    "a folder of *.npz, *.csv or *.parquet files, a trajectory each",
    "a LeRobot data set (meta/info.json)",
    "an HDF5 file in robomimic's layout (*.hdf5)",
    f"{PREFIX}NAME, a Minari data set on this machine",
)


def read_recordings(
    source: str | Path,
    *,
    control_hz: float | None = None,
    observations: Sequence[str] = (),
    action_columns: Sequence[str] = (),
    action_dim: int | None = None,
) -> Recordings:
    """Reads recordings of any robot in any of the formats that there is a reader for.

    Args:
        source (str or Path): a folder of tables, a LeRobot data set, an HDF5 file, or ``minari:NAME``.

    Keyword Args:
        control_hz (float, optional): frames per second. Default: as the source says.
        observations (sequence of str): features of a LeRobot data set, or entries of an HDF5 file, that make up the
            state. Default: all that are no images.
        action_columns (sequence of str): columns of CSV and parquet tables that are actions, if they are not named
            ``action...``.
        action_dim (int, optional): number of action columns of tables without actions.

    Returns:
        Recordings: trajectories with the names and units that the format has.

    Raises:
        RecordingsError: with all faults, named (:mod:`torchrl_koap.data.recordings`).
        FileNotFoundError: if there is no such source.
        ValueError: if it is in none of the formats, or an option does not fit its format.

    Examples:
        >>> from torchrl_koap.data import read_recordings
        >>> read_recordings("/data/so100_pick")  # doctest: +SKIP
    """
    text, path = str(source), Path(source)
    chosen = list(observations) or None
    if text.startswith(PREFIX):
        _unfit("a Minari data set", observations=observations, action_columns=action_columns)
        return read_minari(text.removeprefix(PREFIX), control_hz=control_hz)
    if is_hdf5(path):
        _unfit("an HDF5 file", action_columns=action_columns)
        return read_robomimic(path, observations=chosen, control_hz=control_hz)
    if is_lerobot(path):
        _unfit("a LeRobot data set", action_columns=action_columns)
        found = read_lerobot_recordings(path, features=chosen)
        return found if control_hz is None else replace(found, control_hz=control_hz)
    if path.is_dir() and is_table_folder(path):
        _unfit("a folder of tables", observations=observations)
        columns = list(action_columns) or None
        return read_tables(path, control_hz=control_hz, action_columns=columns, action_dim=action_dim)
    if not path.exists():
        raise FileNotFoundError(f"{source} does not exist")
    raise ValueError(f"{source} holds no recordings that can be read; there are readers for {'; '.join(FORMATS)}")


def _unfit(what: str, **options: Sequence[str]) -> None:
    given = [name for name, value in options.items() if value]
    if given:
        raise ValueError(f"{', '.join(given)}: not an option for {what}")
