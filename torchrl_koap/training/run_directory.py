# This source code is licensed under the MIT license found in the LICENSE file.
"""A run directory: configuration, metrics and summary as plain files that are always complete."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_koap.files import replacing_file


class RunDirectoryError(ValueError):
    """A folder that cannot be used as asked: of another run, or incomplete."""


class RunDirectory:
    """Reads and writes the files of one run.

    ``config.json`` (all options), ``metrics.csv`` (one row per logged step), ``summary.json``, ``eval.json``, weights
    and pictures. JSON is written aside and renamed, so that a full disk leaves the earlier file.

    Args:
        path (str or Path): the folder; it need not exist yet.

    Examples:
        >>> import tempfile
        >>> from torchrl_koap.training.run_directory import RunDirectory
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     run = RunDirectory(folder)
        ...     run.write_json("config.json", {"task": "avoiding"})
        ...     run.log("planner", 1, {"loss_planner": 0.5})
        ...     run.read_json("config.json")["task"], run.read_metrics()[0]["loss_planner"]
        ('avoiding', '0.5')
    """

    COLUMNS = (
        "phase",
        "step",
        "loss_planner",
        "loss_reconstruction",
        "loss_koopman",
        "loss_kl",
        "loss_dynamics",
        "loss_action",
        "loss_policy",
        "learning_rate",
        "iterations_per_second",
    )

    def __init__(self, path: str | Path):
        self.path = Path(path)

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Writes a JSON file in one go; numbers that are not finite, which JSON does not know, become null."""
        with replacing_file(self.path / name) as aside:
            aside.write_text(json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")

    def read_json(self, name: str) -> dict[str, Any]:
        """Reads a JSON file.

        Raises:
            RunDirectoryError: if it is not there or damaged; the message names it.
        """
        path = self.path / name
        if not path.is_file():
            raise RunDirectoryError(f"{path} is missing: is {self.path} the folder of a finished `koap train`?")
        try:
            content = json.loads(path.read_text())
        except ValueError as error:
            raise RunDirectoryError(f"{path} is damaged: {error}") from error
        if not isinstance(content, dict):
            raise RunDirectoryError(f"{path} is damaged: expected an object, got {type(content).__name__}")
        return content

    def read_entry(self, name: str, key: str) -> Any:
        """Reads one entry of a JSON file.

        Raises:
            RunDirectoryError: if the file or the entry is not there; the message names both.
        """
        content = self.read_json(name)
        if key not in content:
            raise RunDirectoryError(f"{self.path / name} has no entry {key!r}")
        return content[key]

    def log(self, phase: str, step: int, values: Mapping[str, float]) -> None:
        """Appends a row to ``metrics.csv``."""
        path = self.path / "metrics.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        fresh = not path.exists()
        with path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self.COLUMNS)
            if fresh:
                writer.writeheader()
            writer.writerow({"phase": phase, "step": step, **values})

    def read_metrics(self) -> list[dict[str, str]]:
        """All complete rows of ``metrics.csv``; none if there is no such file.

        A row that was cut off when a process was killed or the disk was full is left out.
        """
        path = self.path / "metrics.csv"
        if not path.exists():
            return []
        with path.open(newline="") as file:
            return list(csv.DictReader(line for line in file if line.endswith("\n")))

    def last_metrics(self, phase: str) -> dict[str, float]:
        """The values of the last row of a phase; none if there is none."""
        rows = [row for row in self.read_metrics() if row["phase"] == phase]
        if not rows:
            return {}
        return {key: float(value) for key, value in rows[-1].items() if value and key not in ("phase", "step")}

    def rewind_metrics(self, phase: str, step: int) -> None:
        """Drops the rows of ``phase`` behind ``step``, and those of later phases, before a run goes on from there."""
        if not (self.path / "metrics.csv").exists():
            return
        kept = []
        for row in self.read_metrics():
            if row["phase"] == phase and int(row["step"]) > step:
                break
            kept.append(row)
        with replacing_file(self.path / "metrics.csv") as aside, aside.open("w", newline="") as file:
            writer = csv.DictWriter(file, self.COLUMNS)
            writer.writeheader()
            writer.writerows(kept)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
