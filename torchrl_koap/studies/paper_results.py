# This source code is licensed under the MIT license found in the LICENSE file.
"""Both tables of the paper as data, to be set beside measured figures: 165 cells, with its levels of labels.

A cell is a mean success and what the paper prints after its ``+-``, presumably the standard deviation over seeds. The
paper's Stacking, which counts one box, is :data:`~torchrl_koap.tasks.TASKS`' ``stacking_unobserved_joints`` (its state)
and, with the joints observed, ``stacking_1``. What the paper does not have is None here, never an estimate.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from torchrl_koap.lookup import lookup


@dataclass(frozen=True)
class PaperCell:
    """A cell of the paper's tables.

    Args:
        table (int): 1 (methods) or 2 (variants of KOAP).
        level (int): label level, 1 for the fewest labels.
        label_share (float): share of the labels at this level.
        success (float): mean success in 0..1.
        spread (float): what is printed after the ``+-``, in the same unit.
    """

    table: int
    task: str
    method: str
    level: int
    label_share: float
    success: float
    spread: float

    @property
    def text(self) -> str:
        """Success and spread in percent."""
        return f"{100 * self.success:.1f} +- {100 * self.spread:.1f}"


@functools.cache
def _content() -> dict[str, Any]:
    return json.loads(files("torchrl_koap.studies").joinpath("paper_results.json").read_text(encoding="utf-8"))


def paper_levels(task: str) -> tuple[float, ...]:
    """Shares of labels of the paper's levels, the fewest first; empty for a task that is not in the paper."""
    entries = [entry for entry in _content()["tasks"].values() if task in entry["tasks"]]
    return tuple(percent / 100 for entry in entries for percent in entry["label_percent"])


def paper_cells(table: int) -> list[PaperCell]:
    """All cells of a table; a task that stands for one of the paper's in several ways has them in each.

    Raises:
        ValueError: for another table.
    """
    tables = _content()["tables"]
    lookup(tuple(tables), str(table), "table of the paper")
    return [
        PaperCell(table, task, method, level, shares[level - 1] / 100, round(success / 100, 4), round(spread / 100, 4))
        for name, methods in tables[str(table)].items()
        for task in _content()["tasks"][name]["tasks"]
        for method, cells in methods.items()
        for shares in (_content()["tasks"][name]["label_percent"],)
        for level, (success, spread) in enumerate(cells, start=1)
    ]


def paper_cell(task: str, method: str, level: int) -> PaperCell | None:
    """A cell of the paper, None if it has no such one; of both tables the first; level 1 has the fewest labels."""
    return _by_place().get((task, method, level))


@functools.cache
def _by_place() -> dict[tuple[str, str, int], PaperCell]:
    cells = [cell for table in (2, 1) for cell in paper_cells(table)]  # table 1 goes before
    return {(cell.task, cell.method, cell.level): cell for cell in cells}


def paper_points(task: str) -> list[PaperCell]:
    """The cells of a task in both tables, each method and level once."""
    return [cell for cell in _by_place().values() if cell.task == task]
