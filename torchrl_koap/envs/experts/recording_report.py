# This source code is licensed under the MIT license found in the LICENSE file.
"""What was recorded, and what it took."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from torchrl_koap.envs.experts.disturbances import count_spells
from torchrl_koap.envs.experts.recording import FAULTS
from torchrl_koap.tasks import Task


@dataclass(frozen=True)
class Take:
    """One demonstration and what it took.

    Args:
        index (int): number of the demonstration.
        frames (np.ndarray): float64 ``[T, obs]``.
        actions (np.ndarray): float64 ``[T - 1, act]``.
        mode (int): its mode.
        rows (int): its control steps.
        attempts (int): attempts it took, 1 if the first one was good.
        failures (dict): discarded attempts by reason.
        disturbed (bool): whether the operator was disturbed.
        spells (tuple): disturbances of the attempt that was kept: first control step, the one after the last, kind.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import iterate_takes
        >>> take = next(iterate_takes("avoiding", 1))
        >>> take.index, take.attempts, take.failures, take.disturbed
        (0, 1, {}, False)
    """

    index: int
    frames: np.ndarray
    actions: np.ndarray
    mode: int
    rows: int
    attempts: int
    failures: dict[str, int]
    disturbed: bool = False
    spells: tuple[tuple[int, int, str], ...] = ()


@dataclass(frozen=True)
class RecordingReport:
    """What was recorded, and what it took.

    Args:
        task (str): name of the task.
        seed (int): seed of the recording.
        modes, rows, attempts (list of int): of each demonstration, as :class:`Take` has them.
        failures (dict): number of discarded attempts by reason: ``collision``, ``mode``, ``unfinished``,
            ``close`` (nearly touched a cylinder), ``slow``.
        seconds (float): wall-clock time.
        num_modes (int): modes the task has.
        disturbance (float): share of the demonstrations that was to be disturbed.
        disturbed, spells (list): of each demonstration.

    Examples:
        >>> from torchrl_koap.envs.experts.demonstrations import RecordingReport
        >>> report = RecordingReport("avoiding", 0, modes=[3, 7], rows=[80, 95], attempts=[1, 2], failures={"mode": 1})
        >>> str(report)[:39]
        '2 demonstrations of avoiding in 2 modes'
    """

    task: str
    seed: int
    modes: list[int]
    rows: list[int]
    attempts: list[int]
    failures: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    num_modes: int = 0
    disturbance: float = 0.0
    disturbed: list[bool] = field(default_factory=list)
    spells: list[list[tuple[int, int, str]]] = field(default_factory=list)

    @classmethod
    def of(cls, task: Task, seed: int, takes: Sequence[Take | dict], seconds: float, disturbance: float = 0.0):
        """Sums up all demonstrations of a recording.

        Args:
            task (Task): the task.
            seed (int): seed of the recording.
            takes (sequence of Take, or of mappings with its entries): in the order of the demonstrations.
            seconds (float): wall-clock time.
            disturbance (float): share of the demonstrations that was to be disturbed.
        """
        rows = [take if isinstance(take, dict) else vars(take) for take in takes]
        return cls(
            task.name,
            seed,
            modes=[row["mode"] for row in rows],
            rows=[row["rows"] for row in rows],
            attempts=[row["attempts"] for row in rows],
            failures={name: sum(row["failures"].get(name, 0) for row in rows) for name in FAULTS},
            seconds=seconds,
            num_modes=task.num_modes,
            disturbance=disturbance,
            disturbed=[bool(row["disturbed"]) for row in rows],
            spells=[[tuple(spell) for spell in row["spells"]] for row in rows],
        )

    @property
    def notes(self) -> dict[str, Any]:
        """What ``about.json`` says of the recording. Disturbances are told only where there are any."""
        notes = {"seed": self.seed, "modes": list(self.modes), "attempts": list(self.attempts)}
        notes["discarded_attempts"] = dict(self.failures)
        if not self.disturbance:
            return notes
        chosen = [attempts for attempts, disturbed in zip(self.attempts, self.disturbed, strict=True) if disturbed]
        return notes | {
            "disturbance": {
                "share": self.disturbance,
                "disturbed_demonstrations": len(chosen),
                "attempts_under_disturbance": sum(chosen),
                "recovered_at_the_first_attempt": chosen.count(1),
                "kept": count_spells(self.spells),
                "spells": [[list(spell) for spell in spells] for spells in self.spells],
            }
        }

    def __str__(self) -> str:
        discarded = ", ".join(f"{count} {reason}" for reason, count in self.failures.items() if count) or "none"
        counts = [self.modes.count(mode) for mode in range(self.num_modes or max(self.modes) + 1)]
        return (
            f"{len(self.modes)} demonstrations of {self.task} in {len(set(self.modes))} modes"
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
