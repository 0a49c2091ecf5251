# This source code is licensed under the MIT license found in the LICENSE file.
"""Tables of the page about Scooping."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from tables import percent, read_rows, table

STARTS = ("left", "near", "right")
_CELL = ("labels", "unlabelled", "method")


def scooping_cells(rows: Sequence[Mapping[str, str]] | None = None) -> list[dict[str, Any]]:
    """Cells of the study, each with the rollouts of all its training seeds; of a seed those of its longest row.

    Args:
        rows (sequence of mapping, optional): rows of ``scooping.csv``. Default: those that are committed.

    Returns:
        list of dict: the cell's columns, ``n``, ``successes``, ``rims``, ``seeds``, mean rates by start position, and
        ``action_error_mrad``, a list with an entry per seed.
    """
    longest: dict[tuple[str, ...], dict[str, Mapping[str, str]]] = {}
    for row in read_rows("scooping") if rows is None else rows:
        seeds = longest.setdefault(tuple(row[key] for key in _CELL), {})
        if row["seed"] not in seeds or int(seeds[row["seed"]]["n"]) < int(row["n"]):
            seeds[row["seed"]] = row
    cells = []
    for cell, seeds in longest.items():
        own = list(seeds.values())
        counts = {key: sum(int(row[key]) for row in own) for key in ("n", "successes", "rims")}
        rates = {s: sum(int(row["n"]) * float(row[s]) for row in own) / counts["n"] for s in STARTS}
        errors = [float(row["action_error_mrad"]) for row in own if row["action_error_mrad"]]
        more = {"seeds": sorted(seeds), "action_error_mrad": errors}
        cells.append(dict(zip(_CELL, cell, strict=True)) | counts | rates | more)
    return cells


def scooping_table(task: str = "scooping") -> str:
    """A row per cell of the study.

    Args:
        task (str): ``"scooping"`` or ``"scooping_moving_bowl"``.
    """
    cells = scooping_cells(read_rows(task))
    order = ("both", "robot", "hand", "none")
    cells.sort(key=lambda cell: (int(cell["labels"]), order.index(cell["unlabelled"]), -cell["successes"] / cell["n"]))
    body = []
    for cell in cells:
        starts = " / ".join(f"{100 * cell[start]:.0f}" for start in STARTS)
        errors = sorted(cell["action_error_mrad"])
        error = f"{errors[0]:.0f}" + (f" to {errors[-1]:.0f}" if len(errors) > 1 else "") if errors else "not measured"
        rim = percent({"successes": cell["rims"], "n": cell["n"]}, 0)
        first = [cell["labels"], cell["unlabelled"], f"`{cell['method']}`", " ".join(cell["seeds"]), str(cell["n"])]
        body.append([*first, rim, percent(cell, 0), starts, error])
    head = ["labelled", "unlabelled", "method", "seeds", "rollouts", "rim", "success", "left / near / right (%)"]
    return table([*head, "action error (mrad)"], body)
