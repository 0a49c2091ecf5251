# This source code is licensed under the MIT license found in the LICENSE file.
"""The table of a curve while its cells come in: every finished cell is read once, not again after each other one."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchrl_koap.studies.cells import Cell, cell_row
from torchrl_koap.studies.table import write_cells

EVERY = 1.0  # s between two writes while cells end
_SHARE = 0.05  # of the time that writes may take, where there are thousands of cells


class CurveTable:
    """``cells.csv`` of a curve.

    Args:
        root (Path): folder of the curve.
        cells (sequence of Cell): its cells.

    Keyword Args:
        task (str): name of the task.
        label_unit (str): what the fractions are shares of.

    Examples:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchrl_koap.studies.cells import Cell
        >>> from torchrl_koap.studies.curve_table import CurveTable
        >>> cell = Cell("koap", 0.02, 1.0, 0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     table = CurveTable(Path(folder), [cell], task="avoiding", label_unit="trajectory")
        ...     table.is_done(cell), table.write()[0]["status"], sorted(path.name for path in Path(folder).iterdir())
        (False, 'missing', ['cells.csv'])
    """

    def __init__(self, root: Path, cells: Sequence[Cell], *, task: str, label_unit: str):
        self.root, self.task, self.label_unit = root, task, label_unit
        self._rows = {cell: self._read(cell) for cell in cells}
        self._next = 0.0

    def _read(self, cell: Cell, reason: str | None = None) -> dict[str, Any]:
        return cell_row(self.root, cell, task=self.task, label_unit=self.label_unit, reason=reason)

    def is_done(self, cell: Cell) -> bool:
        """Whether a cell was finished and its results can be read."""
        return self._rows[cell]["status"] == "done"

    def ended(self, cell: Cell, reason: str | None) -> None:
        """Reads a cell that has just ended; the table is written unless that was done a moment ago.

        Args:
            cell (Cell): the cell.
            reason (str, optional): why it failed.
        """
        self._rows[cell] = self._read(cell, reason)
        if time.monotonic() >= self._next:
            self.write()

    def write(self) -> list[dict[str, Any]]:
        """Writes the table and returns its rows."""
        rows, began = list(self._rows.values()), time.monotonic()
        write_cells(self.root / "cells.csv", rows)
        ended = time.monotonic()
        self._next = ended + max(EVERY, (ended - began) / _SHARE)
        return rows
