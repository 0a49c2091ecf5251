# This source code is licensed under the MIT license found in the LICENSE file.
"""Cells of a study pooled over training seeds; cells that are not done stay counted."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchrl_koap.evaluation.offline import KIND
from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.lookup import lookup

STATUSES = ("done", "failed", "missing")
MEASURES = (
    "mode_entropy",
    "action_error",
    "relative_action_error",
    "relative_plan_error",
    "labelled_transitions",
    "trajectories_touched",
    "train_seconds",
    "eval_seconds",
)


@dataclass(frozen=True)
class Measure:
    """A mean with its ends: of ``"success"`` the Wilson 95 % interval, of all others the least and greatest seed."""

    mean: float
    low: float
    high: float

    @property
    def text(self) -> str:
        """A share with its ends in percent: ``50.0 % (20.0-80.0)``."""
        return f"{percent(self.mean, 1)} ({100 * self.low:.1f}-{100 * self.high:.1f})"


@dataclass(frozen=True)
class Summary:
    """All seeds of a method at one share of labels.

    ``labels`` and ``demonstrations`` are shares; ``done``, ``failed`` and ``missing`` the seeds whose cell is that.
    ``measures`` are ``"success"``, ``"seed_success"`` (worst and best seed) and those :data:`MEASURES` that some cell
    has.
    """

    task: str
    method: str
    labels: float
    demonstrations: float
    label_unit: str
    done: tuple[int, ...]
    failed: tuple[int, ...]
    missing: tuple[int, ...]
    successes: int
    episodes: int
    measures: Mapping[str, Measure]

    @property
    def offline(self) -> bool:
        """Whether cells are done and none was rolled out: a task without an environment."""
        return bool(self.done) and not self.episodes

    def mean(self, name: str) -> float | None:
        """The mean of a measure, or ``labels`` or ``demonstrations``; None where no cell has it."""
        if name in ("labels", "demonstrations"):
            return self.labels if name == "labels" else self.demonstrations
        return self.measures[name].mean if name in self.measures else None


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[Summary]:
    """Pools the seeds of every method and share of labels; methods and tasks keep their order, shares ascend.

    The Wilson interval takes every episode for independent. The same contexts recur for every seed, so it is too narrow
    where seeds differ more than chance: look at the range of the seeds beside it.

    Cells have at least task, method, labels, seed and status.

    Raises:
        ValueError: if a cell occurs twice, or is done without its number of episodes and successes.
    """
    groups: dict[tuple, dict[int, Mapping[str, Any]]] = {}
    tasks, methods = [list(dict.fromkeys(row[name] for row in rows)) for name in ("task", "method")]
    for row in rows:
        lookup(STATUSES, row["status"], "status of a cell")
        key = (tasks.index(row["task"]), *group_of(row), methods.index(row["method"]))
        cells = groups.setdefault(key, {})
        if row["seed"] in cells:
            raise ValueError(f"the cell {cell_name(row)} occurs twice")
        needed = needed_when_done(row) if row["status"] == "done" else ()
        if needed and (not row.get("episodes") or row.get("successes") is None):
            raise ValueError(f"the cell {cell_name(row)} is done but has no 'episodes' or 'successes'")
        cells[row["seed"]] = row
    return [
        _summary(tasks[task], methods[method], labels, demonstrations, unit, groups[key])
        for key in sorted(groups)
        for task, unit, demonstrations, labels, method in [key]
    ]


def group_of(row: Mapping[str, Any]) -> tuple[str, float, float]:
    """Unit of the labels, share of the demonstrations and share of the labels of a cell."""
    demonstrations = row.get("demonstrations")
    return row.get("label_unit") or "", 1.0 if demonstrations is None else demonstrations, row["labels"]


def _summary(task: str, method: str, labels: float, demonstrations: float, unit: str, cells: Mapping) -> Summary:
    seeds = {status: tuple(sorted(s for s, row in cells.items() if row["status"] == status)) for status in STATUSES}
    done = [cells[seed] for seed in seeds["done"]]
    rolled_out = [row for row in done if row.get("episodes")]
    successes, episodes = (sum(row[name] for row in rolled_out) for name in ("successes", "episodes"))
    measures = {name: Measure(statistics.fmean(found), min(found), max(found)) for name, found in _values(done)}
    if episodes:
        rates = [row["successes"] / row["episodes"] for row in rolled_out]
        rate = successes / episodes
        measures["success"] = Measure(rate, *wilson_interval(successes, episodes))
        measures["seed_success"] = Measure(rate, min(rates), max(rates))
    return Summary(
        task, method, labels, demonstrations, unit, **seeds, successes=successes, episodes=episodes, measures=measures
    )


def _values(rows: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[float]]]:
    found = [(name, [row[name] for row in rows if row.get(name) is not None]) for name in MEASURES]
    finite = [(name, [value for value in values if math.isfinite(value)]) for name, values in found]
    return [(name, values) for name, values in finite if values]


def needed_when_done(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Columns that a cell which is done must have: those of its rollouts, none where it has no environment."""
    return () if row.get("kind") == KIND else ("episodes", "successes")


def cell_name(row: Mapping[str, Any]) -> str:
    """A cell in words: ``avoiding, koap, 2 % labels, seed 1``."""
    demonstrations = row.get("demonstrations")
    used = "" if demonstrations in (None, 1.0) else f"{percent(demonstrations)} of the demonstrations, "
    return f"{row['task']}, {row['method']}, {percent(row['labels'])} labels, {used}seed {row['seed']}"


def percent(share: float | None, digits: int | None = None) -> str:
    """A share in percent, with as few digits as it has if ``digits`` is not given; None gives a dash.

    Examples:
        >>> from torchrl_koap.studies.summary import percent
        >>> percent(0.02), percent(0.005), percent(2 / 3, 1), percent(None)
        ('2 %', '0.5 %', '66.7 %', '–')
    """
    if share is None:
        return "–"
    return f"{100 * share:.6g} %" if digits is None else f"{100 * share:.{digits}f} %"


def plural(unit: str) -> str:
    """What the labels are counted in, in words; "" is any unit."""
    return {"trajectory": "trajectories", "": "labels"}.get(unit, f"{unit}s")
