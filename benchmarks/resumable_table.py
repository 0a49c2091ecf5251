# This source code is licensed under the MIT license found in the LICENSE file.
"""A table that a study appends to row by row, so that it goes on where it stopped."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from pathlib import Path


def open_table(
    table: Path, columns: Sequence[str], keys: Sequence[str]
) -> tuple[set[tuple[str, ...]], Callable[[Sequence[object]], None]]:
    """What a table holds already, and a function that adds a row; a new table gets its header.

    Args:
        table (Path): the file; its folder is made if it is not there.
        columns (sequence of str): of the table.
        keys (sequence of str): columns that tell cells of the study apart.

    Returns:
        tuple: the keys of the rows that are there, and the function.
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
