# This source code is licensed under the MIT license found in the LICENSE file.
"""The cells of a study as a file, pooled over training seeds, and as a table; includes cells that are not done."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

from torchrl_koap.data.label_budget import plural_of
from torchrl_koap.evaluation.statistics import wilson_interval

STATUSES = ("done", "failed", "missing")
CELL_COLUMNS = (
    *("task", "method", "labels", "demonstrations", "seed", "label_unit", "status", "reason"),
    *("labelled_units", "labelled_transitions", "trajectories_touched"),
    *("episodes", "successes", "success_rate", "success_low", "success_high", "mode_entropy", "collisions"),
    *("mean_steps", "action_error", "relative_action_error", "relative_plan_error", "kind", "controller_updates"),
    *("action_errors_on", "action_error_unit", "train_seconds", "eval_seconds", "run"),
)
_MEASURES = (
    *("mode_entropy", "action_error", "relative_action_error", "relative_plan_error"),
    *("labelled_transitions", "trajectories_touched", "train_seconds", "eval_seconds"),
)


Place = tuple[str, str, float, float]
"""Task, unit of the labels, share of the demonstrations and share of the labels."""


@dataclass(frozen=True)
class Measure:
    """A mean with its ends: the Wilson 95 % interval for ``"success"``, else the least and greatest seed."""

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

    ``labels`` and ``demonstrations`` are shares; ``done``, ``failed`` and ``missing`` are seeds by the status of their
    cells. ``measures`` are ``"success"``, ``"seed_success"`` (worst and best seed) and the numeric columns of any cell.
    """

    task: str
    method: str
    labels: float
    demonstrations: float
    label_unit: str
    done: tuple[int, ...]
    failed: tuple[int, ...]
    missing: tuple[int, ...]
    episodes: int
    measures: Mapping[str, Measure]
    action_errors_on: tuple[str, ...] = ()  # the labels on which action errors were measured without an environment
    action_error_units: tuple[str, ...] = ()

    @property
    def offline(self) -> bool:
        """Whether cells are done but none was rolled out, for a task without an environment."""
        return bool(self.done) and not self.episodes

    def mean(self, name: str) -> float | None:
        """Returns the mean of a measure, or ``labels`` or ``demonstrations``; None if no cell has it."""
        if name in ("labels", "demonstrations"):
            return self.labels if name == "labels" else self.demonstrations
        return self.measures[name].mean if name in self.measures else None


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[Summary]:
    """Pools the seeds of every method and share of labels; methods and tasks keep their order, shares ascend.

    The Wilson interval assumes independent episodes. But the same contexts recur for every seed, so it is too narrow if
    seeds differ by more than chance: compare it with the range of the seeds.

    Cells have at least task, method, labels, demonstrations, seed, label_unit and status. Raises a ValueError for a
    cell that occurs twice.
    """
    places = group_cells(rows).items()
    return [_summary(*place, method, cells) for place, methods in places for method, cells in methods.items()]


def group_cells(rows: Sequence[Mapping[str, Any]]) -> dict[Place, dict[str, dict[int, Mapping[str, Any]]]]:
    """Groups cells by place, method and seed, in the order of :func:`summarise`; a ValueError for a repeated cell."""
    tasks, methods = [list(dict.fromkeys(row[name] for row in rows)) for name in ("task", "method")]
    place = itemgetter("task", "label_unit", "demonstrations", "labels")
    order = sorted(rows, key=lambda row: (tasks.index(row["task"]), *place(row)[1:], methods.index(row["method"])))
    places: dict[Place, dict[str, dict[int, Mapping[str, Any]]]] = {}
    for row in order:
        cells = places.setdefault(place(row), {}).setdefault(row["method"], {})
        if row["seed"] in cells:
            raise ValueError(f"the cell {cell_name(row)} occurs twice")
        cells[row["seed"]] = row
    return places


def _summary(task: str, unit: str, demonstrations: float, labels: float, method: str, cells: Mapping) -> Summary:
    done, failed, missing = (
        tuple(sorted(seed for seed, row in cells.items() if row["status"] == status)) for status in STATUSES
    )
    found = [cells[seed] for seed in done]
    rolled_out = [row for row in found if row.get("episodes")]
    successes, episodes = (sum(row[name] for row in rolled_out) for name in ("successes", "episodes"))
    values = {name: [row[name] for row in found if row.get(name) is not None] for name in _MEASURES}
    measures = {name: Measure(statistics.fmean(v), min(v), max(v)) for name, v in values.items() if v}
    if episodes:
        rates = [row["successes"] / row["episodes"] for row in rolled_out]
        measures["success"] = Measure(successes / episodes, *wilson_interval(successes, episodes))
        measures["seed_success"] = Measure(successes / episodes, min(rates), max(rates))
    names = ("action_errors_on", "action_error_unit")
    on, units = (tuple(sorted({row[name] for row in found if row.get(name)})) for name in names)
    return Summary(task, method, labels, demonstrations, unit, done, failed, missing, episodes, measures, on, units)


def table_rows(summaries: Sequence[Summary]) -> list[dict[str, str]]:
    """Returns the table as text, a row per method and share of labels, without columns that have no value.

    Labels are of one unit, as in a study.
    """
    if not summaries:
        return []
    numbers = {  # heading to measure and form
        "mode entropy": ("mode_entropy", ".2f"),
        "action error (of the mean action's)": ("relative_action_error", ".3g"),
        "plan error (of standing still's)": ("relative_plan_error", ".3g"),
        f"action error ({error_units(summaries) or 'unit of the first column'})": ("action_error", ".3g"),
        "labelled transitions": ("labelled_transitions", ",.0f"),
        "in trajectories": ("trajectories_touched", ".4g"),
        "training (s)": ("train_seconds", ",.0f"),
        "evaluation (s)": ("eval_seconds", ",.0f"),
    }
    rows = [
        {
            "task": item.task,
            f"labels ({plural_of(item.label_unit)})": percent(item.labels),
            "demonstrations used": percent(item.demonstrations),
            "method": item.method,
            **_success(item),
            "action errors on": " and ".join(item.action_errors_on).replace("_", " "),
            "seeds": f"{len(item.done)} of {len(item.done) + len(item.failed) + len(item.missing)}",
            "not done": "; ".join(
                f"{word}: seed {', '.join(map(str, seeds))}"
                for word, seeds in (("failed", item.failed), ("missing", item.missing))
                if seeds
            ),
        }
        | {head: "–" if (v := item.mean(name)) is None else format(v, form) for head, (name, form) in numbers.items()}
        for item in summaries
    ]
    empty = {name for name in rows[0] if all(row[name] in ("", "–") for row in rows)}
    if len({item.task for item in summaries}) == 1:
        empty.add("task")
    if all(item.demonstrations == 1 for item in summaries):
        empty.add("demonstrations used")
    return [{name: text for name, text in row.items() if name not in empty} for row in rows]


def error_units(summaries: Sequence[Summary]) -> str:
    """Returns the units of the action errors, separated by commas."""
    return ", ".join(sorted({unit for item in summaries for unit in item.action_error_units}))


def _success(item: Summary) -> dict[str, str]:
    if item.offline:
        return {"success (95 %)": "–", "n": "–", "range of seeds": "–"}
    text, spread = "no cell done", "–"
    if "success" in item.measures:
        text, seeds = item.measures["success"].text, item.measures["seed_success"]
        spread = f"{100 * seeds.low:.0f}-{100 * seeds.high:.0f} %" if len(item.done) > 1 else "–"
    return {"success (95 %)": text, "n": str(item.episodes), "range of seeds": spread}


def result_rows(rows: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Returns what the terminal shows of a study: success, or action error, by method and share of labels."""
    found = {}
    for item in summarise(rows):
        success, error = item.measures.get("success"), item.mean("relative_action_error")
        text = "no training done" if success is None else f"success {success.text}, n = {item.episodes}"
        if item.offline:
            text = "no action error" if error is None else f"action error {percent(error, 1)} of the mean action's"
        used = "" if item.demonstrations == 1 else f", {percent(item.demonstrations)} of the demonstrations"
        found[f"{item.task}, {item.method}, {percent(item.labels)} labels{used}"] = text
    return found


def as_markdown(table: Sequence[Mapping[str, str]]) -> str:
    """Returns rows of text with the same keys as a markdown table."""
    if not table:
        return "no cells\n"
    lines = [
        "| " + " | ".join(part.replace("|", "\\|") for part in line) + " |"
        for line in [list(table[0]), *(list(row.values()) for row in table)]
    ]
    return "\n".join([lines[0], "|---" * len(table[0]) + "|", *lines[1:], ""])


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Returns the pooled table of all cells in markdown, followed by every cell that is not done with its reason."""
    text, left = as_markdown(table_rows(summarise(rows))), not_done(rows)
    if left:
        verb = "is" if len(left) == 1 else "are"
        text += f"\n{len(left)} of {len(rows)} cells {verb} not done:\n\n" + "".join(f"- {line}\n" for line in left)
    return text


def not_done(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns a line per cell that is not done, with the reason of its failure."""
    return [
        f"{cell_name(row)}: {row['status']}" + (f": {row['reason']}" if row.get("reason") else "")
        for row in rows
        if row["status"] != "done"
    ]


def cell_name(row: Mapping[str, Any]) -> str:
    """Returns a cell in words: ``avoiding, koap, 2 % labels, seed 1``."""
    used = "" if row["demonstrations"] == 1 else f"{percent(row['demonstrations'])} of the demonstrations, "
    return f"{row['task']}, {row['method']}, {percent(row['labels'])} labels, {used}seed {row['seed']}"


def percent(share: float, digits: int | None = None) -> str:
    """Formats a share in percent, with ``digits`` decimals, or with as few as it needs if None."""
    return f"{100 * share:.6g} %" if digits is None else f"{100 * share:.{digits}f} %"
