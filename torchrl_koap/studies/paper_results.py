# This source code is licensed under the MIT license found in the LICENSE file.
"""The paper's figures as data, to be drawn beside measured ones.

``paper_results.json`` holds only figures that were seen in a source, and names it with each. So far that is KOAP's
success on Aligning, Sorting, PO-Sorting and the first box of Stacking at the lowest and the highest label level. Absent
are the levels between, Avoiding, the other methods, the ablations, spreads and entropies: the file lists them under
``missing``. What is absent is None here, never an estimate.

To add a figure, append an entry to ``results`` with table, task, method, level, success (in percent) and source (which
table of which version of the paper), and take it off the list of what is missing; the tests check every entry.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from torchrl_koap.lookup import lookup

_KEYS = ("table", "task", "method", "level", "success", "source")


@functools.cache
def _results() -> tuple[dict[str, Any], ...]:
    content = json.loads(files("torchrl_koap.studies").joinpath("paper_results.json").read_text(encoding="utf-8"))
    for number, row in enumerate(content["results"]):
        if set(row) != set(_KEYS):
            raise ValueError(
                f"paper_results.json, result {number}: expected the keys {', '.join(_KEYS)}, got {list(row)}"
            )
    return tuple(content["results"])


def paper_success(task: str, method: str, level: int) -> float | None:
    """Success rate that the paper gives.

    Args:
        task (str): name of the task, as in :mod:`torchrl_koap.tasks`.
        method (str): name of the method.
        level (int): label level, 1 for the fewest labels.

    Returns:
        float or None: the rate in 0..1; None if it is not known to this package.

    Examples:
        >>> from torchrl_koap.studies.paper_results import paper_success
        >>> paper_success("aligning", "koap", 1), paper_success("aligning", "koap", 3)
        (0.8, None)
    """
    for row in paper_rows("success"):
        if (row["task"], row["method"], row["level"]) == (task, method, level):
            return row["success"]
    return None


def paper_rows(table: str = "success") -> list[dict[str, Any]]:
    """All known figures of a table: ``task``, ``method``, ``level``, ``success`` in 0..1 and ``source``.

    Args:
        table (str): name of the table.

    Raises:
        ValueError: for an unknown table.

    Examples:
        >>> from torchrl_koap.studies.paper_results import paper_rows
        >>> {row["method"] for row in paper_rows()}
        {'koap'}
    """
    lookup(sorted({row["table"] for row in _results()}), table, "table of the paper")
    return [
        {name: row[name] for name in _KEYS[1:]} | {"success": row["success"] / 100}
        for row in _results()
        if row["table"] == table
    ]


def paper_points(task: str, label_levels: Sequence[float]) -> list[dict[str, Any]]:
    """Known success rates of a task at the shares of labels that a benchmark uses for the paper's levels.

    Args:
        task (str): name of the task.
        label_levels (sequence of float): the share of labels of level 1, 2, ...: ``Task.label_levels``.

    Returns:
        list: ``task``, ``method``, ``fraction``, ``success`` in 0..1 and ``source``, as
        :func:`~torchrl_koap.studies.report.write_curve_report` takes them.

    Examples:
        >>> from torchrl_koap.studies.paper_results import paper_points
        >>> [(row["fraction"], row["success"]) for row in paper_points("sorting", (0.01, 0.02, 0.05, 0.1, 0.25))]
        [(0.01, 0.62), (0.25, 0.66)]
    """
    return [
        {"task": task, "method": row["method"], "fraction": label_levels[row["level"] - 1]}
        | {"success": row["success"], "source": row["source"]}
        for row in paper_rows("success")
        if row["task"] == task and row["level"] <= len(label_levels)
    ]
