# This source code is licensed under the MIT license found in the LICENSE file.
"""Figures of the committed CSV files as rows and cells of the tables in docs/results."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.evaluation.statistics import wilson_interval
from torchrl_koap.studies.paper_results import paper_points

SOURCE = Path(__file__).resolve().parent / "results"


def read_rows(name: str, **wanted: Any) -> list[dict[str, str]]:
    """Rows of a CSV file whose columns have the wanted values.

    Args:
        name (str): file without its ending.
        **wanted: column to value; numbers are compared as numbers.

    Raises:
        KeyError: if a column is not in the file.
    """
    with (SOURCE / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, strict=True))
    return [row for row in rows if all(_same(row[column], value) for column, value in wanted.items())]


def _same(text: str, value: Any) -> bool:
    return text == value if isinstance(value, str) else bool(text) and float(text) == value


def rows_if_measured(name: str) -> list[dict[str, str]]:
    """Rows of a CSV file that is there once somebody has measured it; none before."""
    return read_rows(name) if (SOURCE / f"{name}.csv").exists() else []


def percent(row: Mapping[str, str], digits: int = 1) -> str:
    """Success of a row in percent with its Wilson interval."""
    successes, trials = int(row["successes"]), int(row["n"])
    low, high = (100 * end for end in wilson_interval(successes, trials))
    return f"{100 * successes / trials:.{digits}f} % ({low:.{digits}f}-{high:.{digits}f})"


def success(row: Mapping[str, str]) -> str:
    """Success of a row in percent, its interval in whole percent, and the entropy."""
    successes, trials = int(row["successes"]), int(row["n"])
    low, high = (100 * end for end in wilson_interval(successes, trials))
    entropy = f", {float(row['entropy']):.2f}" if row.get("entropy") else ""
    return f"{100 * successes / trials:.1f} ({low:.0f}-{high:.0f}){entropy}"


def pooled(rows: Sequence[Mapping[str, str]]) -> str:
    """Success of several rows together with its Wilson interval and number, and the range of their entropies."""
    counts = {key: str(sum(int(row[key]) for row in rows)) for key in ("successes", "n")}
    entropy = sorted(f"{float(row['entropy']):.2f}" for row in rows)
    ends = entropy[0] if entropy[0] == entropy[-1] else f"{entropy[0]} to {entropy[-1]}"
    return f"{percent(counts)} of {counts['n']} rollouts (entropy {ends})"


def share(fraction: str | float) -> str:
    """A fraction in percent."""
    return f"{100 * float(fraction):.6g} %"


def table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """A markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (head, *body)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def pivot(rows: Sequence[Mapping[str, str]], cell: Any, *, by: str = "label_fraction", head: str = "method") -> str:
    """A table with a row per method and a column per label budget.

    Args:
        rows (sequence of mapping): rows of a file.
        cell (callable): from a row to a text.

    Keyword Args:
        by (str): what the columns are.
        head (str): heading of the first column.
    """
    places = list(dict.fromkeys(row[by] for row in rows))
    methods = list(dict.fromkeys(row["method"] for row in rows))
    found = {(row["method"], row[by]): cell(row) for row in rows}
    body = [[f"`{method}`", *(found.get((method, place), "") for place in places)] for method in methods]
    return table([head, *map(share, places)], body)


def difference(row: Mapping[str, str]) -> str:
    """A difference in percentage points with its interval."""
    return f"{float(row['difference']):+.1f} ({int(row['low']):+d} to {int(row['high']):+d})"


def fact(key: str, form: str = "") -> str:
    """A single figure with its unit.

    Args:
        key (str): its key in ``facts.csv``.
        form (str): ``"count"`` for "k of n", ``"rate"`` for percent with interval, ``"bare"`` for no unit.
    """
    (row,) = read_rows("facts", key=key)
    if form == "rate" or (row["successes"] and not form):
        return percent(row)
    if form == "count":
        return f"{row['successes']} of {row['n']}"
    return row["value"] if form == "bare" or not row["unit"] else f"{row['value']} {row['unit']}"


def first(column: str) -> Any:
    """A cell of a pivot table: a column as it is."""
    return lambda row: row[column]


def label_sizes(study: str) -> list[list[str]]:
    """What every share of the labels of a study is."""
    found = {}
    for row in read_rows("label_curves", study=study):
        numbers = [row["labelled_trajectories"], f"{int(row['labelled_transitions']):,}"]
        found[row["label_fraction"]] = [share(row["label_fraction"]), *numbers]
    return list(found.values())


def spread(row: Mapping[str, str]) -> str:
    """A mean error with its range over seeds."""
    return f"{row['error']} ({row['low']}-{row['high']})"


def to_koap(row: Mapping[str, str]) -> str:
    """A paired difference with its interval, empty where there is none."""
    if not row["difference"]:
        return ""
    return f"{row['difference']} ({row['difference_low']} to {row['difference_high']})"


def count_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the results by number of labelled demonstrations."""
    return [
        [f"{row['demonstrations']} {row['data']}", f"`{row['method']}`", row["labelled_trajectories"], spread(row)]
        + [row["ridge_error"], percent(row), row["entropy"], row["pooled_entropy"]]
        for row in rows
    ]


def window_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the results with labels on windows."""
    return [
        [
            f"{row['demonstrations']} {row['data']}",
            *(", ".join(row[f"{kind}_seed_{n}"] for n in range(3)) for kind in ("error", "ridge")),
            percent(row),
            row["entropy"],
        ]
        for row in rows
    ]


def error_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of action errors."""
    return [
        [row["task"], share(row["label_fraction"]), f"`{row['method']}`", f"{spread(row)} {row['unit']}", to_koap(row)]
        for row in rows
    ]


def suggestion_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the criteria by which demonstrations are labelled."""
    return [
        [row["chosen"], f"`{row['criterion']}`", row["labelled_transitions"], spread(row), to_koap(row)]
        + [row["random_error"]]
        for row in rows
    ]


def level_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of tasks and labels: KOAP, the recurrent network, and the paper's KOAP at the same share."""
    other = {(row["task"], row["label_fraction"]): percent(row) for row in rows if row["method"] == "recurrent"}
    return [
        [row["task"] + (f", {row['goal']}" if row["goal"] else ""), share(row["label_fraction"]), percent(row)]
        + [other.get((row["task"], row["label_fraction"]), "not run"), row["entropy"], paper_at_share(row)]
        for row in rows
        if row["method"] == "koap"
    ]


def paper_at_share(row: Mapping[str, str]) -> str:
    """The paper's KOAP at the share of labels of a row, empty where it has no such level or counts another goal."""
    task = {"stacking": "stacking_1"}.get(row["task"], row["task"])
    if row["goal"] not in ("", "first box"):
        return ""
    points = [point for point in paper_points(task, [float(row["label_fraction"])]) if point["method"] == "koap"]
    return "".join(f"{100 * point['success']:.1f} +- {100 * point['spread']:.1f}" for point in points)


def env_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the environments' speed."""
    return [
        [row["task"], row["batch"], row["threads"], f"{int(row['median']):,}", f"{row['over_original']}x"]
        for row in rows
    ]


def training_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the speed of training and planning."""
    names = ("updates_per_second", "plan_1_ms", "plan_60_ms")
    return [
        [row["part"], row["variant"], f"{int(row['parameters']):,}", *(row[name] for name in names)] for row in rows
    ]


def precision_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of updates per second by the number type of the matrix products."""
    return [[row["processor"], "yes" if row["units"] == "1" else "no", *list(row.values())[2:]] for row in rows]


def left_out_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of what it takes to leave trajectories out, without the number of penalties, which is the same in all."""
    return [[value for name, value in row.items() if name != "penalties"] for row in rows]


def ablation_rows(topic: str) -> list[list[str]]:
    """Table of the ablations of a topic: successes with their interval, other measures with their unit."""
    return [
        [row["variant"], row["condition"], row["measure"]]
        + [f"{row['successes']}/{row['n']} = {percent(row)}" if row["successes"] else f"{row['value']} {row['unit']}"]
        for row in read_rows("ablations", topic=topic)
    ]


def tracking_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the distances to a perfect plan."""
    names = ("labelled_trajectories", "blend_decay", "step_12", "step_30", "step_48")
    return [[row[name] for name in names] for row in rows]


def export_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the ways to call a whole policy."""
    return [list(row.values()) for row in rows]


def own_robot_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Seed, updates, seconds, goals, largest distance, errors of actions."""
    names = ("seed", "updates", "train_seconds", "worst_distance_rad", "action_error_rad", "ridge_error_rad")
    body = [[row[name] for name in names] for row in rows]
    return [
        [*line[:3], f"{row['goals_reached']} of {row['goals']}", *line[3:]]
        for line, row in zip(body, rows, strict=True)
    ]


def preset_rows(rows: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Table of the presets."""
    return [[row["preset"], row["decoder"], f"{row['action_error']} {row['unit']}"] for row in rows]
