# This source code is licensed under the MIT license found in the LICENSE file.
"""The cells of a study as a file and as a table."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.files import replacing_file
from torchrl_koap.lookup import lookup
from torchrl_koap.studies.summary import STATUSES, Summary, cell_name, needed_when_done, percent, plural, summarise

_KINDS = {
    "task": str,
    "method": str,
    "labels": float,
    "demonstrations": float,
    "seed": int,
    "label_unit": str,
    "status": str,
    "reason": str,
    "labelled_units": int,
    "labelled_transitions": int,
    "trajectories_touched": int,
    "episodes": int,
    "successes": int,
    "success_rate": float,
    "success_low": float,
    "success_high": float,
    "mode_entropy": float,
    "collisions": int,
    "mean_steps": float,
    "action_error": float,
    "relative_action_error": float,
    "relative_plan_error": float,
    "kind": str,
    "controller_updates": int,
    "train_seconds": float,
    "eval_seconds": float,
    "run": str,
}
CELL_COLUMNS = tuple(_KINDS)
_ALWAYS = ("task", "method", "labels", "demonstrations", "seed", "status")
_WORDS = {int: "a whole number", float: "a finite number"}


def write_cells(path: str | Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Writes cells as csv, aside first; what a row lacks, and what is not a finite number, stays empty.

    Raises:
        ValueError: for another column than :data:`CELL_COLUMNS`, or an unknown status.
    """
    for row in rows:
        for name in row:
            lookup(CELL_COLUMNS, name, "column of a cell")
        lookup(STATUSES, row.get("status"), "status of a cell")
    return write_csv(
        Path(path), CELL_COLUMNS, [{name: _written(row.get(name)) for name in CELL_COLUMNS} for row in rows]
    )


def write_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> Path:
    """Writes rows as csv, aside first."""
    with replacing_file(path) as aside, aside.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    return path


def _written(value: Any) -> Any:
    if isinstance(value, str):
        return " ".join(value.split())  # a reason of several lines becomes one
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


def read_cells(path: str | Path) -> list[dict[str, Any]]:
    """Reads a file of :func:`write_cells` with its types; empty numbers are None, columns may be in another order.

    Raises:
        ValueError: if the file is damaged; the message names it, the line and the column.
        FileNotFoundError: if it is not there.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file, restkey="", strict=True)
            lines = [(reader.line_num, line) for line in reader]
            names = reader.fieldnames or []
    except (csv.Error, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    for name in CELL_COLUMNS:
        if name not in names:
            raise ValueError(f"{path} lacks the column {name!r}")
    rows = []
    for number, line in lines:
        where = f"{path}, line {number}"
        if line.get("") is not None:
            raise ValueError(f"{where}: more values than the {len(names)} columns")
        row = {name: _read(line[name], name, where) for name in CELL_COLUMNS}
        for name in _ALWAYS + (needed_when_done(row) if row["status"] == "done" else ()):
            if row[name] in (None, ""):
                raise ValueError(f"{where}, column {name!r}: empty")
        rows.append(row)
    return rows


def _read(text: str | None, name: str, where: str) -> Any:
    kind = _KINDS[name]
    if text is None:
        raise ValueError(f"{where}, column {name!r}: the line ends before it")
    if kind is str:
        if name == "status" and text not in STATUSES:
            raise ValueError(f"{where}, column 'status': expected one of {', '.join(STATUSES)}, got {text!r}")
        return text
    if not text:
        return None
    try:
        value = kind(text)
        if not math.isfinite(value):
            raise ValueError
    except ValueError:
        raise ValueError(f"{where}, column {name!r}: expected {_WORDS[kind]}, got {text!r}") from None
    return value


def table_rows(summaries: Sequence[Summary]) -> list[dict[str, str]]:
    """The table as text, a row per method and share of labels; columns without any value are left out."""
    units = {item.label_unit for item in summaries}
    labels = f"labels ({plural(*units)})" if len(units) == 1 and "" not in units else "labels"
    offline = any(item.offline for item in summaries)
    error = "action error (unit of the first column)" if offline else "action error (mm, mrad)"
    numbers = {  # heading to measure and form
        "mode entropy": ("mode_entropy", ".2f"),
        "action error (of the mean action's)": ("relative_action_error", ".3g"),
        "plan error (of standing still's)": ("relative_plan_error", ".3g"),
        error: ("action_error", ".3g"),
        "labelled transitions": ("labelled_transitions", ",.0f"),
        "in trajectories": ("trajectories_touched", ".4g"),
    }
    rows = [
        {
            "task": item.task,
            labels: percent(item.labels) + (f" of {plural(item.label_unit)}" if len(units) > 1 else ""),
            "demonstrations used": percent(item.demonstrations),
            "method": item.method,
            "success (95 %)": "–" if item.offline else _interval(item),
            "n": "–" if item.offline else str(item.episodes),
            "seeds": f"{len(item.done)} of {len(item.done) + len(item.failed) + len(item.missing)}",
            "not done": _not_done(item),
            "range of seeds": _range(item),
        }
        | {head: _number(item.mean(name), form) for head, (name, form) in numbers.items()}
        for item in summaries
    ]
    empty = {name for name in (rows[0] if rows else ()) if all(row[name] in ("", "–") for row in rows)}
    for name, usual in (("task", None), ("demonstrations used", "100 %")):
        values = {row[name] for row in rows}
        if len(values) == 1 and (usual is None or values == {usual}):
            empty.add(name)
    return [{name: text for name, text in row.items() if name not in empty} for row in rows]


def _interval(item: Summary) -> str:
    return item.measures["success"].text if "success" in item.measures else "no cell done"


def _range(item: Summary) -> str:
    if "seed_success" not in item.measures or len(item.done) < 2:
        return "–"
    return f"{100 * item.measures['seed_success'].low:.0f}-{100 * item.measures['seed_success'].high:.0f} %"


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _not_done(item: Summary) -> str:
    parts = [("failed", item.failed), ("missing", item.missing)]
    return "; ".join(f"{word}: seed {', '.join(map(str, seeds))}" for word, seeds in parts if seeds)


def as_markdown(table: Sequence[Mapping[str, str]]) -> str:
    """Rows of text with the same keys as a markdown table."""
    if not table:
        return "no cells\n"
    lines = [
        "| " + " | ".join(part.replace("|", "\\|") for part in line) + " |"
        for line in [list(table[0]), *(list(row.values()) for row in table)]
    ]
    return "\n".join([lines[0], "|---" * len(table[0]) + "|", *lines[1:], ""])


def markdown_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The pooled table of all cells in markdown, and below it every cell that is not done with its reason."""
    text = as_markdown(table_rows(summarise(rows)))
    open_cells = [row for row in rows if row["status"] != "done"]
    if open_cells:
        verb = "is" if len(open_cells) == 1 else "are"
        text += f"\n{len(open_cells)} of {len(rows)} cells {verb} not done:\n\n"
        text += "".join(f"- {cell_name(row)}: {why_not_done(row)}\n" for row in open_cells)
    return text


def why_not_done(row: Mapping[str, Any]) -> str:
    """Status of a cell and the reason of its failure, in one line."""
    reason = " ".join((row.get("reason") or "").split())
    return f"{row['status']}: {reason}" if reason else row["status"]
