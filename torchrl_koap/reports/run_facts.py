# This source code is licensed under the MIT license found in the LICENSE file.
"""Facts about a run: its task and the numbers in its files, read once for pictures, advice and page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_koap.evaluation.statistics import expected_entropy
from torchrl_koap.files import read_json
from torchrl_koap.tasks import Modes, Task
from torchrl_koap.tasks.registry import task_from


def entry_at(value: Any, *keys: str) -> Any:
    """Returns the nested entry at ``keys``; None if it or one on the way is missing or null."""
    for key in keys:
        value = (value or {}).get(key)
    return value


@dataclass(frozen=True)
class RunFacts:
    """Facts about a run: its task, if it is known, and its JSON files.

    Absent or damaged files are empty; ``damaged`` has the messages about damaged ones.
    """

    folder: Path
    task: Task | None = None
    summary: Mapping[str, Any] = field(default_factory=dict)
    evaluation: Mapping[str, Any] = field(default_factory=dict)
    inspection: Mapping[str, Any] = field(default_factory=dict)
    config: Mapping[str, Any] = field(default_factory=dict)
    damaged: tuple[str, ...] = ()

    @classmethod
    def read(cls, folder: str | Path) -> RunFacts:
        """Reads the JSON files of a run directory that exist."""
        folder, damaged = Path(folder), []
        if not folder.is_dir():
            raise FileNotFoundError(f"there is no run directory {str(folder)!r}")
        files: dict[str, dict[str, Any]] = {}
        names = {"config": "config", "summary": "summary", "evaluation": "eval", "inspection": "inspect"}
        for key, name in names.items():
            path, files[key] = folder / f"{name}.json", {}
            try:
                files[key] = read_json(path) if path.exists() else {}
            except (OSError, ValueError) as error:
                damaged.append(str(error))
        try:
            task = task_from(files["config"]["task"], files["config"].get("task_definition"))
        except (ValueError, KeyError, TypeError, AttributeError):  # the task is not registered here
            task = None
        return cls(folder, task, damaged=tuple(damaged), **files)

    @property
    def offline(self) -> bool:
        """Whether the task has no environment, so that the run is evaluated on recorded data."""
        return self.task is not None and self.task.env is None

    @property
    def control_hz(self) -> float | None:
        """Control steps per second of the task, None if it is not known."""
        return None if self.task is None else self.task.control_hz

    @property
    def modes(self) -> Modes:
        """The modes of the task; none if it is unknown or was rolled out in another environment."""
        return Modes() if self.task is None or self.evaluation.get("env") else self.task.modes

    @property
    def rates(self) -> Mapping[str, Mapping[str, Any]]:
        """Shares of the rollouts by name, success first: ``rate``, ``low``, ``high`` and ``episodes`` of each."""
        return self.evaluation.get("rates", {})

    def success(self, entry: str = "rate") -> float | None:
        """Returns the success rate, an end of its interval or the number of rollouts; None if it is missing."""
        return entry_at(self.evaluation, "rates", "success", entry)

    @property
    def successes(self) -> int:
        """Number of successful rollouts."""
        rate, episodes = self.success(), self.success("episodes")
        return round(rate * episodes) if rate and episodes else 0

    @property
    def expected_entropy(self) -> float | None:
        """Mode entropy that a uniform choice would have with as many successes; None without modes or successes."""
        choice = self.modes.number > 1 and self.successes
        return expected_entropy(self.successes, self.modes.number) if choice else None

    @property
    def action_errors(self) -> Mapping[str, Any]:
        """Errors of decoded actions by the labels on which they were measured; each may be a note why it is missing."""
        return self.evaluation.get("action_errors", {})

    def experiment(self, name: str) -> float | None:
        """Returns the success of an experiment of ``koap inspect``, None if it was not made.

        In tasks where objects are moved, the controller alone succeeds if it stays near a recorded tool path.
        """
        left = self.inspection.get("recordings_left")
        if name == "controller_alone" and left is not None:
            return 1 - left["count"] / left["episodes"]
        return entry_at(self.inspection, name, "rate")
