# This source code is licensed under the MIT license found in the LICENSE file.
"""``koap convert``: recordings of one's own robot become a data set that ``koap train`` takes, or another format."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchrl_koap.commands.command import Command
from torchrl_koap.data import read_about, read_recordings, save_demonstrations
from torchrl_koap.data.demonstrations import description_of
from torchrl_koap.data.recordings.recordings import Recordings
from torchrl_koap.data.recordings.writers import WRITERS, recordings_of, stored_task, write_recordings
from torchrl_koap.lookup import lookup

_READING = ("control_hz", "observations", "action_columns", "action_dim")
_DESCRIBING = ("name", "robot", "command", "action_kind", "targets", "action_units", "state_units", "max_steps")


@dataclass(kw_only=True)
class Convert(Command):
    """Turn recordings of any robot, of which few or none have actions, into a data set that holds its whole task.

    What a data set of this library says of its columns is kept where no option says otherwise.

    Attributes:
        source: a folder of *.npz, *.csv or *.parquet files, a LeRobot data set, an HDF5 file in robomimic's layout,
            minari:NAME, or a data set of this library.
        out: folder to write; a file for robomimic, minari:NAME for Minari.
        to: another format than this library's: "npz", "robomimic", "lerobot" (3.0), "lerobot-2.1", "minari" or "d3il"
            (raw pickles of a D3IL task).
        name: name of the task (default: that of the folder).
        control_hz: frames per second (default: as the source says).
        observations: features of a LeRobot data set or entries of an HDF5 file that make up the state (default: all
            that are no images).
        action_columns: columns of CSV or parquet tables that are actions, if they are not named action...
        action_dim: number of action columns, where nothing has actions.
        robot: state columns of the robot itself, which the controller reads (default: all that are no command).
        command: neighbouring columns that repeat the last command; nothing that learns sees them.
        action_kind: "delta" (velocities, efforts, changes) or "absolute" (targets of state columns) (default: delta).
        targets: for absolute actions the state column that each is the target of (default: the robot's).
        action_units: unit of each action column, or one for all.
        state_units: unit of each state column, or one for all.
        max_steps: steps after which an episode counts as failed (default: 1.5 times the longest demonstration).
    """

    source: tyro.conf.Positional[str]
    out: Path
    to: str | None = None
    name: str | None = None
    control_hz: float | None = None
    observations: tuple[str, ...] = ()
    action_columns: tuple[str, ...] = ()
    action_dim: int | None = None
    robot: tuple[str, ...] = ()
    command: tuple[str, ...] = ()
    action_kind: str | None = None
    targets: tuple[str, ...] = ()
    action_units: tuple[str, ...] = ()
    state_units: tuple[str, ...] = ()
    max_steps: int | None = None

    def __call__(self) -> dict[str, Any]:
        """Reads, checks and writes."""
        if self.max_steps is not None and self.max_steps < 1:
            raise ValueError(f"max_steps must be >= 1, got {self.max_steps}")
        own = (Path(self.source) / "ted").is_dir()
        if own:
            self._refuse(_READING, f"{self.source} is a data set of this library, which says it already")
        if self.to is not None:
            lookup(WRITERS, self.to, "format")
            self._refuse(_DESCRIBING, f"format {self.to!r} does not hold it")
            return self._in_another_format(self._read(), self.to)
        if (self.out / "ted").exists():
            raise FileExistsError(f"{self.out / 'ted'} exists already; choose another --out")
        recordings = self._read()
        known = description_of(stored_task(self.source)) if own else {}
        folder = save_demonstrations(self.out, recordings, name=self.name, **known | self._description())
        about = read_about(folder / "ted")
        return {
            "data set": str(folder),
            "task": about["task"],
            "trajectories": about["trajectories"],
            "steps": about["steps"],
            "labelled steps": about["labelled_steps"],
            "states": ", ".join(recordings.state_names),
            "actions": ", ".join(recordings.action_names),
            "frames per second": recordings.control_hz,
            "skipped": ", ".join(recordings.skipped) or "nothing",
            "next": f"koap train --dataset {shlex.quote(str(folder))} --out runs/{about['task']}",
        }

    def _description(self) -> dict[str, Any]:
        """What the options say of the columns."""
        given = {name: getattr(self, name) for name in _DESCRIBING if name != "name"}
        for name in ("action_units", "state_units"):
            if len(given[name]) == 1:  # one for all
                given[name] = given[name][0]
        return {name: value for name, value in given.items() if value not in (None, ())}

    def _refuse(self, options: Sequence[str], why: str) -> None:
        for name in options:
            if getattr(self, name) not in (None, ()):
                raise ValueError(f"--{name.replace('_', '-')} was given, but {why}")

    def _read(self) -> Recordings:
        """The recordings of the source, those of a data set of this library included."""
        if (Path(self.source) / "ted").is_dir():
            return recordings_of(self.source)
        return read_recordings(
            self.source,
            control_hz=self.control_hz,
            observations=self.observations,
            action_columns=self.action_columns,
            action_dim=self.action_dim,
        )

    def _in_another_format(self, recordings: Recordings, kind: str) -> dict[str, Any]:
        written = write_recordings(recordings, self.out, kind)
        return {
            "written": str(written),
            "format": kind,
            "trajectories": len(recordings.states),
            "labelled steps": recordings.num_labels,
            "states": ", ".join(recordings.state_names),
            "actions": ", ".join(recordings.action_names),
            "frames per second": recordings.control_hz,
        }
