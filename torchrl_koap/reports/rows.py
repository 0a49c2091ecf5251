# This source code is licensed under the MIT license found in the LICENSE file.
"""Results of a training and an evaluation as rows of text, for terminal and report."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from torchrl_koap.reports.run_facts import RunFacts, entry_at
from torchrl_koap.tasks.columns import thousandths

_ENTROPIES = {"mode_entropy": "mode entropy", "pooled_mode_entropy": "mode entropy, all contexts together"}
# the run's own model first, then baselines
_PLANS = {"planner": "", "standing_still": "standing still", "constant_velocity": "constant velocity"}
_ACTIONS = {"controller": "", "ridge": "ridge on raw frames", "mean_action": "always the mean action"}
_LABELS = {"outside_budget": "outside the budget", "left_out": "of recordings left out of the fit"}
_LATE = 0.8  # if weights after this share of the updates are best, more updates may help
_NOT_MEASURED = "not measured"


@dataclass(frozen=True)
class Row:
    """A result and its context."""

    name: str  # the measured quantity
    value: str  # the result, with its unit
    note: str = ""  # what to compare it with, and how it was measured
    bar: tuple[float, ...] | None = None  # for a share: it and the ends of its interval in percent


def as_text(rows: Iterable[Row]) -> dict[str, str]:
    """Returns rows for the terminal: value and note by name."""
    return {row.name: "; ".join(filter(None, (row.value, row.note))) for row in rows}


def training_rows(run: RunFacts) -> list[Row]:
    """Returns the labels that a training read, how its parts were trained, and why the planner's training ended."""
    return [row for row in (_labels(run), *_planner(run), _controller(run)) if row is not None]


def evaluation_rows(run: RunFacts) -> list[Row]:
    """Returns errors on recorded data, shares of rollouts with their intervals, and times."""
    rolled_out = *_rates(run), _entropy(run), _environment(run)
    recorded = *_plan_errors(run), *_action_errors(run), _loop(run)
    return [row for row in (*rolled_out, *recorded, _speed(run)) if row is not None]


def _labels(run: RunFacts) -> Row | None:
    labels = run.summary.get("labels")
    if labels is None:
        return None
    seen, there, steps = (labels[f"{kind}_transitions"] for kind in ("labelled", "available", "total"))
    where = f"in {labels['trajectories_touched']:,} of {labels['total_trajectories']:,} recordings"
    more = f"; the data have {there:,} labels" if seen < there < steps else ""
    return Row("labels", f"{seen:,} of {steps:,} steps", where + more)


def _planner(run: RunFacts) -> list[Row]:
    """Returns how the planner was trained, and why training ended; nothing for a method without a planner."""
    asked = run.config.get("planner")
    if not asked or not run.summary.get("planner_parameters"):
        return []
    if asked.get("source") is not None:
        return [Row("planner", f"that of {asked['source']}", "not trained here")]
    names = ("updates", "kept_update", "best_held_out_score")
    updates, kept, score = (entry_at(run.summary, "planner", name) for name in names)
    if updates is None:
        return []
    frames = asked.get("frames")
    seen = "" if frames is None else f", {frames} observed frame{'s' * (frames > 1)}"
    value = f"{updates:,.0f} updates{_seconds(run, 'planner')}{seen}"
    if kept is None or score is None:
        return [Row("planner", value, "no recording was held out")]
    note = f"kept update {kept:,.0f}, with plan score {score:.3g} on held-out recordings (smaller is better)"
    return [Row("planner", value, note), Row("training ended", *_ending(updates, kept, asked.get("steps")))]


def _ending(updates: float, kept: float, most: float | None) -> tuple[str, str]:
    if most is not None and updates < most:
        return f"early, before update {most:,.0f}", f"plans stopped improving at update {kept:,.0f}"
    if kept < _LATE * updates:
        return "with its last update", f"plans stopped improving at update {kept:,.0f}"
    return "with its last update", f"plans improved until late: more updates may help (--steps {2 * updates:.0f})"


def _controller(run: RunFacts) -> Row | None:
    method, updates = run.config.get("method"), run.summary.get("controller_updates")
    if not isinstance(method, str) or updates is None:
        return None
    labels = entry_at(run.summary, "decoder_fit", "labels_used")
    trained = f"{method}, {updates:,} updates{_seconds(run, 'controller')}"
    return Row("controller", trained, "" if labels is None else f"fitted to {labels:,} labels")


def _seconds(run: RunFacts, part: str) -> str:
    seconds = entry_at(run.summary, "train_seconds", part)
    return "" if seconds is None or seconds < 1 else f" in {seconds:.0f} s"  # 0 if it was finished before a resume


def _plan_errors(run: RunFacts) -> list[Row]:
    plan, found = run.evaluation.get("plan_errors", {}), []
    for row in plan.get("unit", ()):
        errors = {words: row[name]["energy_score"]["overall"] for name, words in _PLANS.items()}
        found.append(_error_row("plan error", row, errors, "energy score"))
    return [*found, *([Row("plan error", _NOT_MEASURED, plan["note"])] if "note" in plan else [])]


def _action_errors(run: RunFacts) -> list[Row]:
    split, found = run.evaluation.get("action_errors_on"), []
    judged = run.action_errors[split] if split else {}
    for row in judged.get("unit", ()):
        errors = {words: row[name] for name, words in _ACTIONS.items()}
        labels = f"{judged['labels']:,} labels {_LABELS[split]}"
        found.append(_error_row("action error", row, errors, "root mean square", labels))
    notes = [part["note"] for part in run.action_errors.values() if "note" in part] if run.offline else []
    return found or ([Row("action error", _NOT_MEASURED, "; ".join(notes))] if notes else [])


def _error_row(name: str, row: Mapping[str, Any], errors: Mapping[str, float], kind: str, *more: str) -> Row:
    """Returns the row of errors of the models, by display name, over the columns of one unit."""
    (shown, factor), columns = thousandths(row["unit"]), row["columns"]
    own, *others = (f"{words} {factor * error:.4g}".lstrip() for words, error in errors.items())
    which = columns[0] if len(columns) == 1 else f"{len(columns)} columns"
    note = "; ".join((kind if shown else f"{kind} in units of the data", ", ".join(others), *more))
    return Row(f"{name}, {which}", f"{own} {shown}".rstrip(), note)


def _loop(run: RunFacts) -> Row | None:
    found = run.evaluation.get("loop")
    if found is None:
        return None
    if "note" in found:
        return Row("closed loop", _NOT_MEASURED, found["note"])
    return Row(
        "largest command in a closed loop",
        f"{found['largest_command']:.3g} times",
        f"the largest recorded one, in {found['steps']} steps on a linear model of the robot;"
        f" {found['largest_command_late']:.3g} times in the last third; {found['limited_commands']:,} of"
        f" {found['commands']:,} commands limited; states end {found['distance_to_demonstrations']:.2g} standard"
        " deviations from recorded ones",
    )


def _rates(run: RunFacts) -> list[Row]:
    contexts, found = run.evaluation.get("contexts"), []
    for name, values in run.rates.items():
        rate, low, high = (100 * values[key] for key in ("rate", "low", "high"))
        among = f" in {contexts:g} contexts" if contexts and name == "success" else ""
        count = f"{round(values['rate'] * values['episodes'])} of {values['episodes']:g} rollouts{among}"
        found.append(Row(name, f"{rate:.1f} %", f"95 % interval {low:.1f} to {high:.1f} %, {count}", (rate, low, high)))
    return found


def _entropy(run: RunFacts) -> Row | None:
    modes = run.modes.number
    name = next((name for name in _ENTROPIES if run.evaluation.get(name) is not None), None)
    if name is None or modes < 2:
        return None
    value, low, high = (run.evaluation.get(name + end) for end in ("", "_low", "_high"))
    contexts, episodes = run.evaluation.get("contexts"), run.evaluation.get("episodes")
    notes = [] if low is None else [f"95 % interval {low:.2f} to {high:.2f}"]
    notes.append(f"{run.evaluation['distinct_modes']} of {modes} modes")
    if run.successes and contexts and name == "mode_entropy":
        notes.append(f"mean over contexts, {episodes / contexts:g} rollouts each")
    elif run.successes:
        notes.append(f"a uniform choice averages {run.expected_entropy:.2f}, n = {run.successes}")
    return Row(f"{_ENTROPIES[name]}, base {modes}", f"{value:.2f}", "; ".join(notes))


def _environment(run: RunFacts) -> Row | None:
    made = run.evaluation
    if not made.get("env"):
        return None
    success = f"success: info[{made['success_key']!r}]" if made.get("success_key") else made.get("success")
    limit = f"at most {made['step_limit']}" if made.get("step_limit") else None
    early, left, total = (made.get(name) for name in ("ended_early", "left_out_of_return", "mean_return"))
    ended = f"{early:g} rollouts ended before that without success" if early else None
    notes = ["95 % interval {:.4g} to {:.4g}".format(*ends)] if (ends := made.get("mean_return_interval")) else []
    notes += [f"{left:g} rollouts that an error ended are left out"] if left else []
    about = f" ({'; '.join(notes)})" if notes else ""
    gained = None if total is None else f"mean return {total:.4g}{about}"
    return Row("environment", str(made["env"]), "; ".join(filter(None, (limit, ended, success, gained))))


def _speed(run: RunFacts) -> Row | None:
    plan, control = run.evaluation.get("plan_ms"), run.evaluation.get("control_ms")
    if plan is None:
        return None
    robot = f"; the robot's step has {1000 / run.control_hz:.3g} ms" if run.control_hz else ""
    return Row("time of a plan", f"{plan:.3g} ms", f"then {control:.3g} ms per control step{robot}")
