# This source code is licensed under the MIT license found in the LICENSE file.
"""What was recorded, and what it took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from torchrl_koap.envs.experts.disturbances import count_spells
from torchrl_koap.envs.experts.recording import FAULTS
from torchrl_koap.tasks import Task


@dataclass(frozen=True)
class Take:
    """One demonstration and what it took."""

    index: int  # number of the demonstration
    frames: np.ndarray  # [T, obs]
    actions: np.ndarray  # [T - 1, act]
    mode: int
    rows: int  # control steps
    attempts: int  # that it took, 1 if the first one was good
    failures: dict[str, int]  # discarded attempts by reason
    disturbed: bool = False  # whether the operator was
    # disturbances of the attempt that was kept: first control step, the one after the last, kind
    spells: tuple[tuple[int, int, str], ...] = ()

    @property
    def account(self) -> dict[str, Any]:
        """All but frames and actions."""
        return {name: value for name, value in vars(self).items() if name not in ("frames", "actions")}


@dataclass(frozen=True)
class RecordingReport:
    """What was recorded, and what it took.

    Args:
        task (Task): the task.
        seed (int): seed of the recording.
        takes (sequence of dict): :attr:`Take.account` of each demonstration, in their order.
        seconds (float): wall-clock time.
        disturbance (float): share of the demonstrations that was to be disturbed.
    """

    task: Task
    seed: int
    takes: Sequence[Mapping[str, Any]]
    seconds: float = 0.0
    disturbance: float = 0.0

    @property
    def modes(self) -> list[int]:
        """Mode of each demonstration."""
        return [take["mode"] for take in self.takes]

    @property
    def rows(self) -> list[int]:
        """Control steps of each demonstration."""
        return [take["rows"] for take in self.takes]

    @property
    def attempts(self) -> list[int]:
        """Attempts that each demonstration took."""
        return [take["attempts"] for take in self.takes]

    @property
    def failures(self) -> dict[str, int]:
        """Number of discarded attempts by reason."""
        return {name: sum(take["failures"].get(name, 0) for take in self.takes) for name in FAULTS}

    @property
    def notes(self) -> dict[str, Any]:
        """What ``about.json`` says of the recording. Disturbances are told only where there are any."""
        notes = {"seed": self.seed, "modes": self.modes, "attempts": self.attempts}
        notes["discarded_attempts"] = self.failures
        if not self.disturbance:
            return notes
        chosen = [take["attempts"] for take in self.takes if take["disturbed"]]
        return notes | {
            "disturbance": {
                "share": self.disturbance,
                "disturbed_demonstrations": len(chosen),
                "attempts_under_disturbance": sum(chosen),
                "recovered_at_the_first_attempt": chosen.count(1),
                "kept": count_spells([take["spells"] for take in self.takes]),
                "spells": [[list(spell) for spell in take["spells"]] for take in self.takes],
            }
        }

    def __str__(self) -> str:
        discarded = ", ".join(f"{count} {reason}" for reason, count in self.failures.items() if count) or "none"
        counts = [self.modes.count(mode) for mode in range(self.task.num_modes)]
        return (
            f"{len(self.modes)} demonstrations of {self.task.name} in {len(set(self.modes))} modes"
            f" ({', '.join(map(str, counts))}), {min(self.rows)} to {max(self.rows)} rows, {self.seconds:.1f} s;"
            f" {self.attempts.count(1)} good at the first attempt; discarded attempts: {discarded}{self._disturbances}"
        )

    @property
    def _disturbances(self) -> str:
        if not self.disturbance:
            return ""
        told = self.notes["disturbance"]
        kept = ", ".join(f"{count} {kind}" for kind, count in told["kept"].items())
        return (
            f"; {told['disturbed_demonstrations']} disturbed ({kept}), of which the operator recovered in"
            f" {told['disturbed_demonstrations']} of {told['attempts_under_disturbance']} attempts"
        )
