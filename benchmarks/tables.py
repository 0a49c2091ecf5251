# This source code is licensed under the MIT license found in the LICENSE file.
"""Formats figures of the committed CSV files for the pages in docs/results; reads and writes the tables of studies."""

from __future__ import annotations

import csv
import statistics
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from scipy.stats import t as student

from torchrl_koap.evaluation.statistics import wilson_interval

SOURCE = Path(__file__).resolve().parent / "results"
Row = Mapping[str, str]
METHOD_NAMES = {  # in tables and pictures
    "koap": "KOAP",
    "koap_untrained": "random features",
    "linear_steps": "ridge regression",
    "nonlinear": "nonlinear maps",
    "dd_lookahead": "supervised, look-ahead",
    "dd": "Decision Diffuser",
    "lapo": "LAPO",
    "vpt": "VPT",
    "dp": "Diffusion Policy",
}


def read_rows(name: str, **wanted: Any) -> list[dict[str, str]]:
    """Reads the rows of a CSV file whose columns have the wanted values.

    Args:
        name (str): file below ``results`` without its ending.
        **wanted: column to value; numbers are compared as numbers.

    Raises:
        KeyError: if a column is not in the file.
    """
    with (SOURCE / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file, strict=True))
    return [row for row in rows if all(_same(row[column], value) for column, value in wanted.items())]


def _same(text: str, value: Any) -> bool:
    return text == value if isinstance(value, str) else bool(text) and float(text) == value


def percent(row: Mapping[str, Any], digits: int = 1) -> str:
    """Formats the success of a row in percent with its Wilson interval."""
    rate, low, high = success_interval(int(row["successes"]), int(row["n"]))
    return f"{rate:.{digits}f} % ({low:.{digits}f}-{high:.{digits}f})"


def success_interval(successes: int, trials: int) -> tuple[float, float, float]:
    """Returns a success rate and the ends of its 95 % Wilson interval, in percent."""
    low, high = wilson_interval(successes, trials)
    return 100 * successes / trials, 100 * low, 100 * high


def t_interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Returns the mean of two or more values and the ends of its 95 % t-interval."""
    mean = statistics.fmean(values)
    half = student.ppf(0.975, len(values) - 1) * statistics.stdev(values) / len(values) ** 0.5
    return mean, mean - half, mean + half


def share(fraction: str | float) -> str:
    """Formats a fraction in percent."""
    return f"{100 * float(fraction):.6g} %"


def table(head: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Formats a markdown table."""
    lines = ["| " + " | ".join(row) + " |" for row in (head, *body)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def columns(rows: Sequence[Row], **cells: str) -> str:
    """Formats a markdown table with a column per keyword.

    Args:
        rows (sequence of mapping): rows of a CSV file.
        **cells: heading, with ``_`` for a space, to a format string of the row's columns, such as
            ``"{error} ({low}-{high})"``. ``{percent}`` is the success with its interval. ``{paired}`` is the
            difference with its interval, or empty. Whole numbers take formats of integers (``"{steps:,}"``).
    """
    body = []
    for row in rows:
        known: dict[str, Any] = {name: int(text) if text.isdigit() else text for name, text in row.items()}
        known["percent"] = percent(row) if row.get("successes") else ""
        known["paired"] = (
            "{difference} ({difference_low} to {difference_high})".format(**row) if row.get("difference_low") else ""
        )
        body.append([cell.format(**known) for cell in cells.values()])
    return table([name.replace("_", " ") for name in cells], body)


def total(rows: Sequence[Row], **first: str) -> list[dict[str, str]]:
    """Adds a row with the sums of all columns of whole numbers and the entries ``first``."""
    sums = {name: str(sum(int(row[name]) for row in rows)) for name in rows[0] if rows[0][name].isdigit()}
    return [*map(dict, rows), dict.fromkeys(rows[0], "") | sums | first]


def fact(key: str, form: str = "") -> str:
    """Formats a single figure of ``facts.csv`` with its unit.

    Args:
        key (str): its key.
        form (str): ``"count"`` for "k of n", ``"rate"`` for percent with interval, ``"bare"`` for no unit.
    """
    (row,) = read_rows("facts", key=key)
    if form == "rate" or (row["successes"] and not form):
        return percent(row)
    if form == "count":
        return f"{row['successes']} of {row['n']}"
    return row["value"] if form == "bare" or not row["unit"] else f"{row['value']} {row['unit']}"


def kills(rows: Sequence[Row]) -> list[dict[str, str]]:
    """Counts disturbed runs, signals, runs equal to an undisturbed one and leftover files, by command."""
    counts = []
    for command in dict.fromkeys(row["command"] for row in rows):
        found = [row for row in rows if row["command"] == command]
        counts.append(
            {
                "command": f"`{command}`",
                "runs": str(len(found)),
                "kills": str(sum(len(row["signals"].split()) for row in found)),
                "equal": str(sum(row["equal"] == "yes" for row in found)),
                "leftovers": str(sum(int(row["leftovers"]) for row in found)),
            }
        )
    return total(counts, command="all")


def every(rows: Sequence[Row]) -> list[Row]:
    """Returns the first row, the last, and about three evenly spaced rows between them."""
    return [*rows[: -1 : max(1, len(rows) // 4)], rows[-1]]


def commands(rows: Sequence[Row]) -> str:
    """Formats the commands that produced the rows as a code block."""
    lines = dict.fromkeys(row["command"] for row in rows if row["command"])
    return "```bash\n" + "\n".join(lines) + "\n```"


def open_table(
    table: Path, columns: Sequence[str], keys: Sequence[str]
) -> tuple[set[tuple[str, ...]], Callable[[Sequence[object]], None]]:
    """Returns the keys of a table's rows and a function that appends a row; creates the table if needed.

    Args:
        table (Path): the file; its folder is created if it does not exist.
        columns (sequence of str): columns of the table.
        keys (sequence of str): columns that identify a cell of the study.

    Returns:
        tuple: the keys of the existing rows, and the function.
    """
    done: set[tuple[str, ...]] = set()
    if table.exists():
        with table.open(newline="", encoding="utf-8") as file:
            done = {tuple(row[key] for key in keys) for row in csv.DictReader(file)}
    else:
        table.parent.mkdir(parents=True, exist_ok=True)
        table.write_text(",".join(columns) + "\n", encoding="utf-8")

    def write(row: Sequence[object]) -> None:
        with table.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerow(row)

    return done, write


def write_table(file: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes the rows of a study as a CSV file; replaces an existing file."""
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
