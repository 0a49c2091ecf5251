# This source code is licensed under the MIT license found in the LICENSE file.
"""Pooling the cells of a label-efficiency curve over training seeds; cells that are not done stay counted."""

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


@dataclass(frozen=True)
class Summary:
    """All seeds of a method at one budget; means are over the cells that are done, None where no cell has the value.

    Args:
        task (str): the task.
        method (str): the method.
        fraction (float): share of the labels.
        observations (float): share of the trajectories used at all.
        label_unit (str): what the share is of.
        done (tuple of int): seeds whose cell is done.
        failed (tuple of int): seeds whose cell failed.
        missing (tuple of int): seeds whose cell is not there.
        successes (int): over all done cells.
        episodes (int): over all done cells.
        success (float, optional): their ratio; ``low`` and ``high`` are its Wilson 95 % interval.
        lowest (float, optional): success of the worst seed; ``highest`` that of the best.
        entropy (float, optional): mean entropy of the modes; ``entropy_low`` and ``entropy_high`` are those of single
            seeds.
        action_error (float, optional): mean; ``action_error_low`` and ``action_error_high`` are those of single seeds.
        relative_action_error (float, optional): mean error of the actions as a share of that of the mean action, of a
            task without an environment; ``_low`` and ``_high`` as above.
        relative_plan_error (float, optional): mean error of plans as a share of that of standing still, likewise.
        labelled_transitions (float, optional): mean number of distinct transitions whose action was read.
        trajectories_touched (float, optional): mean number of trajectories they lie in.
        train_seconds (float, optional): mean time of training; ``eval_seconds`` that of evaluation.

    Examples:
        >>> from torchrl_koap.studies.summary import summarise
        >>> cell = {"task": "avoiding", "method": "koap", "fraction": 0.02, "seed": 0, "status": "missing"}
        >>> summary = summarise([cell])[0]
        >>> summary.missing, summary.success is None
        ((0,), True)
    """

    task: str
    method: str
    fraction: float
    observations: float
    label_unit: str
    done: tuple[int, ...]
    failed: tuple[int, ...]
    missing: tuple[int, ...]
    successes: int
    episodes: int
    success: float | None
    low: float | None
    high: float | None
    lowest: float | None
    highest: float | None
    entropy: float | None
    entropy_low: float | None
    entropy_high: float | None
    action_error: float | None
    action_error_low: float | None
    action_error_high: float | None
    relative_action_error: float | None
    relative_action_error_low: float | None
    relative_action_error_high: float | None
    relative_plan_error: float | None
    labelled_transitions: float | None
    trajectories_touched: float | None
    train_seconds: float | None
    eval_seconds: float | None

    @property
    def offline(self) -> bool:
        """Whether cells are done and none was rolled out: a task without an environment."""
        return bool(self.done) and not self.episodes


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[Summary]:
    """Pools the seeds of every method and budget; methods and tasks keep their order, budgets ascend.

    The Wilson interval takes every episode for independent. The same contexts recur for every seed, so it is too narrow
    where seeds differ more than chance: look at the range of the seeds beside it.

    Args:
        rows (sequence of mapping): cells, with at least task, method, fraction, seed and status.

    Raises:
        ValueError: if a cell occurs twice, or is done without its number of episodes and successes.

    Examples:
        >>> from torchrl_koap.studies.summary import summarise
        >>> cell = {"task": "avoiding", "method": "koap", "fraction": 0.02, "status": "done", "episodes": 30}
        >>> pooled = summarise([cell | {"seed": 0, "successes": 30}, cell | {"seed": 1, "successes": 15}])[0]
        >>> pooled.success, pooled.episodes, pooled.lowest, pooled.done
        (0.75, 60, 0.5, (0, 1))
    """
    groups: dict[tuple, dict[int, Mapping[str, Any]]] = {}
    tasks, methods = [list(dict.fromkeys(row[name] for row in rows)) for name in ("task", "method")]
    for row in rows:
        lookup(STATUSES, row["status"], "status of a cell")
        observations = row.get("observations")
        key = (
            tasks.index(row["task"]),
            row.get("label_unit") or "",
            1.0 if observations is None else observations,
            row["fraction"],
            methods.index(row["method"]),
        )
        cells = groups.setdefault(key, {})
        if row["seed"] in cells:
            raise ValueError(f"the cell {cell_name(row)} occurs twice")
        needed = needed_when_done(row) if row["status"] == "done" else ()
        if needed and (not row.get("episodes") or row.get("successes") is None):
            raise ValueError(f"the cell {cell_name(row)} is done but has no 'episodes' or 'successes'")
        cells[row["seed"]] = row
    return [
        _summary(tasks[task], methods[method], fraction, observations, unit, groups[key])
        for key in sorted(groups)
        for task, unit, observations, fraction, method in [key]
    ]


def _summary(task: str, method: str, fraction: float, observations: float, unit: str, cells: Mapping) -> Summary:
    seeds = {status: tuple(sorted(s for s, row in cells.items() if row["status"] == status)) for status in STATUSES}
    done = [cells[seed] for seed in seeds["done"]]
    rolled_out = [row for row in done if row.get("episodes")]
    successes, episodes = (sum(row[name] for row in rolled_out) for name in ("successes", "episodes"))
    low, high = wilson_interval(successes, episodes) if episodes else (None, None)
    rates = [row["successes"] / row["episodes"] for row in rolled_out]
    shares = _values(done, "relative_action_error")
    errors, entropies = _values(done, "action_error"), _values(done, "mode_entropy")
    return Summary(
        task=task,
        method=method,
        fraction=fraction,
        observations=observations,
        label_unit=unit,
        **seeds,
        successes=successes,
        episodes=episodes,
        success=successes / episodes if episodes else None,
        low=low,
        high=high,
        lowest=min(rates, default=None),
        highest=max(rates, default=None),
        entropy=_mean(done, "mode_entropy"),
        entropy_low=min(entropies, default=None),
        entropy_high=max(entropies, default=None),
        action_error=_mean(done, "action_error"),
        action_error_low=min(errors, default=None),
        action_error_high=max(errors, default=None),
        relative_action_error=_mean(done, "relative_action_error"),
        relative_action_error_low=min(shares, default=None),
        relative_action_error_high=max(shares, default=None),
        relative_plan_error=_mean(done, "relative_plan_error"),
        labelled_transitions=_mean(done, "labelled_transitions"),
        trajectories_touched=_mean(done, "trajectories_touched"),
        train_seconds=_mean(done, "train_seconds"),
        eval_seconds=_mean(done, "eval_seconds"),
    )


def _values(rows: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    values = [row.get(name) for row in rows]
    return [value for value in values if value is not None and math.isfinite(value)]


def needed_when_done(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Columns that a cell which is done must have: those of its rollouts, none where it has no environment.

    Args:
        row (mapping): the cell; its ``kind`` is ``"offline"`` where there was no environment.

    Examples:
        >>> from torchrl_koap.studies.summary import needed_when_done
        >>> needed_when_done({"kind": "offline"}), needed_when_done({})
        ((), ('episodes', 'successes'))
    """
    return () if row.get("kind") == KIND else ("episodes", "successes")


def _mean(rows: Sequence[Mapping[str, Any]], name: str) -> float | None:
    values = _values(rows, name)
    return statistics.fmean(values) if values else None


def cell_name(row: Mapping[str, Any]) -> str:
    """A cell in words.

    Examples:
        >>> from torchrl_koap.studies.summary import cell_name
        >>> cell_name({"task": "avoiding", "method": "koap", "fraction": 0.02, "seed": 1})
        'avoiding, koap, 2 % labels, seed 1'
    """
    observations = row.get("observations")
    used = "" if observations in (None, 1.0) else f"{percent(observations)} of the trajectories, "
    return f"{row['task']}, {row['method']}, {percent(row['fraction'])} labels, {used}seed {row['seed']}"


def percent(share: float | None, digits: int | None = None) -> str:
    """A share in percent, with as few digits as it has if ``digits`` is not given.

    Args:
        share (float, optional): the share, 1 for the whole; None gives a dash.
        digits (int, optional): digits after the point.

    Examples:
        >>> from torchrl_koap.studies.summary import percent
        >>> percent(0.02), percent(0.005), percent(2 / 3, 1), percent(None)
        ('2 %', '0.5 %', '66.7 %', '–')
    """
    if share is None:
        return "–"
    return f"{100 * share:.6g} %" if digits is None else f"{100 * share:.{digits}f} %"


def plural(unit: str) -> str:
    """What a budget of labels counts, in words.

    Examples:
        >>> from torchrl_koap.studies.summary import plural
        >>> plural("trajectory"), plural("window"), plural("")
        ('trajectories', 'windows', 'labels')
    """
    return {"trajectory": "trajectories", "": "labels"}.get(unit, f"{unit}s")
