# This source code is licensed under the MIT license found in the LICENSE file.
"""The headline numbers of a run's page, those that there are, each with its interval."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchrl_koap.reports.html import duration
from torchrl_koap.reports.run_facts import RunFacts, number
from torchrl_koap.tasks.units import thousandths

_ENTROPIES = {"mode_entropy": "mode entropy", "pooled_mode_entropy": "mode entropy, all contexts together"}
_PLAN_BASELINES = ("standing_still", "constant_velocity")


def tiles(run: RunFacts) -> list[dict[str, Any]]:
    """Returns name, value, note and bar (or None) of every headline number of a run."""
    found = [*_offline_errors(run), *_rates(run), _entropy(run), _labels(run), _speed(run)]
    return [item for item in (*found, _time(run)) if item is not None]


def _tile(name: str, value: str, note: str, interval: tuple[float, ...] | None = None) -> dict[str, Any]:
    return {"name": name, "value": value, "note": note, "bar": interval}


def _offline_errors(run: RunFacts) -> list[dict[str, Any]]:
    """Errors of plans and actions on recorded data."""
    found, evaluation = [], run.evaluation
    for row in evaluation.get("plan_errors", {}).get("unit", ()):
        shown, factor = thousandths(row["unit"])
        values = {name: factor * row[name]["energy_score"]["overall"] for name in ("planner", *_PLAN_BASELINES)}
        note = ", ".join(f"{name.replace('_', ' ')} {values[name]:.3g}" for name in _PLAN_BASELINES)
        head = f"plan error, energy score, {len(row['columns'])} columns"
        found.append(_tile(head, f"{values['planner']:.3g} {shown}".rstrip(), note))
    split = evaluation.get("action_errors_on")
    errors = run.action_errors[split] if split else {}
    for row in errors.get("unit", ()):
        shown, factor = thousandths(row["unit"])
        others = [f"{name.replace('_', ' ')} {factor * row[name]:.3g}" for name in ("ridge", "mean_action")]
        others.append(f"n = {errors['labels']:,} labels, {split.replace('_', ' ')}")
        head = f"action error, {len(row['columns'])} columns"
        found.append(_tile(head, f"{factor * row['controller']:.3g} {shown}".rstrip(), ", ".join(others)))
    return found


def _rates(run: RunFacts) -> list[dict[str, Any]]:
    """Shares of the rollouts: success, and those that the task's own score adds."""
    contexts, found = run.evaluated("contexts"), []
    for name, values in run.rates.items():
        rate, low, high, total = (number(values.get(key)) for key in ("rate", "low", "high", "episodes"))
        if rate is None:
            continue
        notes, interval = [], None
        if low is not None and high is not None:
            notes = [f"95 % interval {100 * low:.1f} to {100 * high:.1f} %"]
            interval = tuple(100 * min(max(part, 0.0), 1.0) for part in (rate, low, high))
        if total:
            among = f" in {contexts:g} contexts" if contexts and name == "success" else ""
            notes.append(f"{round(rate * total)} of {total:g} rollouts{among}")
        found.append(_tile(name, f"{100 * rate:.1f} %", ", ".join(notes), interval))
    return found


def _entropy(run: RunFacts) -> dict[str, Any] | None:
    """Entropy of the modes, of tasks that can be done in several ways."""
    modes = run.modes.number
    name = next((name for name in _ENTROPIES if run.evaluated(name) is not None), None)
    if name is None or modes < 2:
        return None
    value, low, high = (run.evaluated(name + end) for end in ("", "_low", "_high"))
    contexts, episodes = run.evaluated("contexts"), run.evaluated("episodes")
    notes = [] if low is None or high is None else [f"95 % interval {low:.2f} to {high:.2f}"]
    distinct = run.evaluation.get("distinct_modes")
    notes += [] if distinct is None else [f"{distinct} of {modes} modes"]
    if run.successes and contexts and name == "mode_entropy":
        notes += [f"mean over contexts, {episodes / contexts:g} rollouts each"] if episodes else []
    elif run.successes:
        notes.append(f"a uniform choice averages {run.expected_entropy:.2f}, n = {run.successes}")
    return _tile(f"{_ENTROPIES[name]}, base {modes}", f"{value:.2f}", "; ".join(notes))


def _labels(run: RunFacts) -> dict[str, Any] | None:
    if run.labels is None:
        return None
    labels: Mapping[str, Any] = run.summary["labels"]
    total, touched, trajectories = (
        number(labels.get(key)) for key in ("total_transitions", "trajectories_touched", "total_trajectories")
    )
    notes = [f"{run.labels / total:.2%} of {total:,.0f} transitions".replace("%", " %")] if total else []
    notes += [f"in {touched:g} of {trajectories:g} demonstrations"] if touched is not None and trajectories else []
    return _tile("action labels", f"{run.labels:,.0f}", ", ".join(notes))


def _speed(run: RunFacts) -> dict[str, Any] | None:
    rate = run.evaluated("control_hz")
    if rate is None:
        return None
    parts = {"plan_ms": "ms per plan", "control_ms": "ms per control step"}
    notes = [f"{run.evaluated(key):.3g} {what}" for key, what in parts.items() if run.evaluated(key)]
    return _tile("control rate", f"{rate:.0f} Hz", ", ".join(notes))


def _time(run: RunFacts) -> dict[str, Any] | None:
    seconds = run.summary.get("train_seconds")
    seconds = seconds if isinstance(seconds, Mapping) else {"": seconds}
    spent = {key: value for key in seconds if (value := number(seconds[key])) is not None}
    if not spent:
        return None
    note = ", ".join(f"{key} {duration(value)}" for key, value in spent.items() if key)
    return _tile("training time", duration(sum(value for key, value in spent.items() if key != "total")), note)
