# This source code is licensed under the MIT license found in the LICENSE file.
"""Rows about faults, kills, load and versions for the page that shows them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Row = Mapping[str, str]


def ledger_rows(rows: Sequence[Row]) -> list[list[str]]:
    """Part of the ledger, its faults, and how many were not met as they should be, by kind; the sum last."""
    names = ("faults", "hangs", "tracebacks", "accepted", "wording")
    total = [str(sum(int(row[name]) for row in rows)) for name in names]
    return [*([row["part"], *(row[name] for name in names)] for row in rows), ["all", *total]]


def kill_rows(rows: Sequence[Row]) -> list[list[str]]:
    """Command, disturbed runs, signals sent, runs equal to an undisturbed one, files left over; the sum last."""
    made = []
    for command in [*dict.fromkeys(row["command"] for row in rows), "all"]:
        mine = [row for row in rows if command in (row["command"], "all")]
        kills = sum(len(row["signals"].split()) for row in mine)
        equal = sum(row["equal"] == "yes" for row in mine)
        left = sum(int(row["leftovers"]) for row in mine)
        made.append([f"`{command}`" if command != "all" else command, *map(str, (len(mine), kills, equal, left))])
    return made


def soak_rows(rows: Sequence[Row], every: int = 4) -> list[list[str]]:
    """Memory after some of the batches: the first, the last, and a few between."""
    step = max(1, len(rows) // every)
    chosen = [*rows[:-1:step], rows[-1]]
    return [[row["episodes"], row["in_use_mb"], row["resident_mb"]] for row in chosen]


def raw_rows(rows: Sequence[Row]) -> list[list[str]]:
    """Raw files, their steps and size, and what it takes to convert and to check them."""
    names = ("files", "steps", "data_mb", "seconds", "convert_mb", "validate_mb")
    return [[row[name] for name in names] for row in rows]


def resume_rows(rows: Sequence[Row]) -> list[list[str]]:
    """What a call finds, and how long it takes to go on with the cells that are missing."""
    names = ("call", "cells", "missing", "cells_read", "begins_processor", "begins_after", "seconds")
    return [[row[name] for name in names] for row in rows]


def version_rows(rows: Sequence[Row]) -> list[list[str]]:
    """Python, versions, what was done, tests, and the versions of the largest packages."""
    names = ("torch", "numpy", "mujoco", "numba")
    return [
        [row["python"], row["versions"], row["outcome"], row["passed"], row["failed"], *(row[name] for name in names)]
        for row in rows
    ]
