# This source code is licensed under the MIT license found in the LICENSE file.
"""A run directory: plain files that are never half written, found by path or by the name of a trained policy."""

from __future__ import annotations

import contextlib
import csv
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from torchrl_koap.data.formats import find_format
from torchrl_koap.data.ted import CAMERAS, stored_folder
from torchrl_koap.files import (
    DataError,
    LockedError,
    check_file,
    check_folder,
    one_at_a_time,
    read_json,
    replacing_file,
)
from torchrl_koap.lookup import lookup

PREFIX = "pretrained:"
_NETWORKS = ("planner.safetensors", "controller.safetensors")
# files of a run, without evaluations, reports and checkpoints
FILES = ("config.json", "summary.json", "metrics.csv", "demonstrations.safetensors", *_NETWORKS)


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as csv, atomically; values that are missing stay empty."""
    with replacing_file(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)


class RunDirectoryError(ValueError):
    """A folder that cannot be used as asked: it holds another run, or is incomplete."""


class RunDirectory:
    """Reads and writes the files of one run.

    ``config.json`` (all options), ``metrics.csv`` (one row per logged step), ``summary.json``, ``eval.json``, weights
    and pictures. JSON is written to a temporary file and renamed, so that a full disk leaves the earlier file. The
    folder need not exist yet.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file atomically; numbers that are not finite, which JSON lacks, become null."""
        finite = json.loads(json.dumps(content), parse_constant=lambda word: None)
        with replacing_file(self.path / name) as aside:
            aside.write_text(json.dumps(finite, indent=2) + "\n")

    def read_json(self, name: str) -> dict[str, Any]:
        """Reads a JSON file; a RunDirectoryError names a file that is missing or damaged."""
        path = self.path / name
        if not path.exists():
            missing = path if self.path.is_dir() else self.path
            raise RunDirectoryError(f"{missing} is missing: wanted the folder of a finished `koap train`")
        try:
            return read_json(path)
        except DataError as error:
            raise RunDirectoryError(f"{path} is damaged: {error.problems[0]}") from error

    def refuse_data(self) -> None:
        """Raises a RunDirectoryError if the folder holds a data set or, without a run, recordings."""
        held = stored_folder(self.path)
        ours = any((self.path / name).exists() for name in FILES)  # ``metrics.csv`` is a table, too
        if held is None and not ours and find_format(self.path) is not None:
            held = self.path
        if held is not None:
            raise RunDirectoryError(f"{held} holds data, which need a folder of their own; choose another --out")

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        """Appends a row to ``metrics.csv``: the values (losses, learning rate, speed) after a step of a phase.

        A value with a new name adds a column.
        """
        path = self.path / "metrics.csv"
        row = {"phase": phase, "step": step, **values}
        columns = self._columns()
        new = [name for name in row if name not in columns]
        if new:
            write_csv(path, [*columns, *new], self.read_metrics())
            columns += new
        try:
            with path.open("a", newline="") as file:
                csv.DictWriter(file, columns).writerow(row)
        except OSError as error:  # the error of a full disk does not name the file
            raise OSError(error.errno, f"{path} could not be written: {error.strerror}") from error

    def _columns(self) -> list[str]:
        path = self.path / "metrics.csv"
        if not path.exists():
            return []
        with path.open(newline="") as file:
            head = file.readline()
        return next(csv.reader([head]), []) if head.endswith("\n") else []

    def read_metrics(self) -> list[dict[str, str]]:
        """Returns all complete rows of ``metrics.csv``; none if there is no such file.

        A row cut off by a killed process or a full disk is left out. A RunDirectoryError names a complete row that is
        damaged.
        """
        path = self.path / "metrics.csv"
        if not path.exists():
            return []
        try:
            check_file(path)
            with path.open(newline="") as file:
                rows = list(csv.DictReader(line for line in file if line.endswith("\n")))
        except (csv.Error, UnicodeDecodeError) as error:
            raise RunDirectoryError(f"{path} is damaged: {error}") from error
        for row in rows:
            _check_row(path, row)
        return rows

    def last_metrics(self, phase: str) -> dict[str, float]:
        """Returns the values of the last row of a phase and its number of ``updates``; empty without a row."""
        rows = [row for row in self.read_metrics() if row["phase"] == phase]
        if not rows:
            return {}
        values: dict[str, float] = {
            key: int(value) if value.isdecimal() else float(value)
            for key, value in rows[-1].items()
            if value and key not in ("phase", "step")
        }
        return values | {"updates": int(rows[-1]["step"])}

    def seconds(self) -> dict[str, float]:
        """Returns the time of each phase's updates from its rows, those of interrupted calls included."""
        took, done = dict[str, float](), dict[str, int]()
        for row in self.read_metrics():
            phase, step = row["phase"], int(row["step"])
            rate = float(row.get("iterations_per_second") or "inf")
            took[phase] = took.get(phase, 0.0) + (step - done.get(phase, 0)) / rate
            done[phase] = step
        return took

    def rewind_metrics(self, phase: str, step: int) -> None:
        """Drops the rows of ``phase`` after ``step``, and those of later phases, before a run resumes from there."""
        kept = takewhile(lambda row: row["phase"] != phase or int(row["step"]) <= step, self.read_metrics())
        if (path := self.path / "metrics.csv").exists():
            write_csv(path, self._columns(), list(kept))

    @contextlib.contextmanager
    def locked(self, what: str, name: str = ".lock") -> Iterator[None]:
        """Locks the folder during the block for ``what``, such as ``"koap train"``.

        Removes partial checkpoints of killed processes first. Raises a RunDirectoryError if another process works in
        the folder.
        """
        with contextlib.ExitStack() as held:
            try:
                busy = f"another command is working in {self.path}: call `{what}` again when it has ended"
                held.enter_context(one_at_a_time(self.path / name, busy=busy))
            except LockedError as error:
                raise RunDirectoryError(error) from None
            for partial in (self.path / "checkpoints").glob(".*.tmp"):  # only the holder of the lock writes there
                partial.unlink(missing_ok=True)
            yield


def _check_row(path: Path, row: Mapping[str, Any]) -> None:
    try:
        if not row["phase"] or int(row["step"]) < 0 or None in row:
            raise ValueError("wanted a phase, a step >= 0, and a value or nothing for every other column")
        for name, value in row.items():
            if value and name not in ("phase", "step"):
                float(value)
    except (KeyError, TypeError, ValueError) as error:
        found = ", ".join(f"{value}" for value in row.values())
        raise RunDirectoryError(f"{path} is damaged in the row {found[:60]!r}: {error}") from error


def pretrained_folders() -> dict[str, Path]:
    """Returns names and folders of the trained policies, in the current folder or in the checkout."""
    roots = [Path("pretrained"), Path(__file__).resolve().parents[2] / "pretrained"]
    folders = [folder for root in roots if root.is_dir() for folder in sorted(root.iterdir())]
    return {folder.name: folder for folder in reversed(folders) if (folder / "config.json").exists()}


def find_run(name: object) -> Path:
    """Returns the folder of a run: a path as given, or that of ``pretrained:NAME``; errors suggest the nearest name."""
    if not isinstance(name, (str, Path)):
        made = "train(TrainConfig(...)) writes one, fit() does not"
        raise TypeError(f"a run must be named by its folder, got {type(name).__name__}: {made}")
    name = str(name)
    if not name.startswith(PREFIX):
        return Path(name)
    folders = pretrained_folders()
    if not folders:
        raise RunDirectoryError(
            f"{name!r} was asked for, but there is no folder 'pretrained' here or beside the package: it is part of the"
            " repository, not of an installed wheel"
        )
    return lookup(folders, name.removeprefix(PREFIX), "pretrained policy")


def no_data(where: str | None, run: str | Path | None) -> RunDirectoryError:
    """Makes the error for demonstrations of a run that are missing at their recorded path."""
    return RunDirectoryError(
        f"the data set {where!r} of {run} is not there (moved, or named relative to another working directory?): give"
        " its folder with --dataset"
    )


def copy_run(source: str | Path, target: str | Path) -> Path:
    """Copies the files of a run, without those of evaluations, to a folder that is new or holds the same run."""
    source, target = Path(source), Path(target)
    config = RunDirectory(source).read_json("config.json")
    RunDirectory(target).refuse_data()
    if (target / "config.json").exists() and RunDirectory(target).read_json("config.json") != config:
        raise RunDirectoryError(f"{target} holds another run than {source}; choose another --out")
    target.mkdir(parents=True, exist_ok=True)
    if target.samefile(source):
        return target
    for name in FILES:
        if (source / name).exists():
            shutil.copyfile(source / name, target / name)
    if (source / CAMERAS).is_dir():
        shutil.copytree(source / CAMERAS, target / CAMERAS, dirs_exist_ok=True)
    return target


def writable_folder(run: str | Path, out: str | Path | None = None) -> Path:
    """Returns the folder for results about a run: its own, or ``out``, to which the files of the run are copied.

    Raises a ValueError for a pretrained run without ``out``.
    """
    source = find_run(run)
    if out is not None:
        return copy_run(source, out)
    if str(run).startswith(PREFIX):
        raise ValueError(f"nothing is written into {run}: choose another folder with --out")
    check_folder(source)
    return source
