# This source code is licensed under the MIT license found in the LICENSE file.
"""Measured cells in the layout of the paper's tables, its own beside them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torchrl_koap.files import replacing_file
from torchrl_koap.studies.paper_results import PaperCell, paper_cell, paper_levels
from torchrl_koap.studies.plots import plot_average
from torchrl_koap.studies.summary import Summary, percent, summarise
from torchrl_koap.studies.table import as_markdown
from torchrl_koap.tasks import TASKS

AVERAGE = "plots/average.png"
DEFAULT = "task's default"  # what pictures call the method that a task is trained with unless told otherwise


@dataclass(frozen=True)
class Entry:
    """A measured cell, pooled over seeds, and the paper's; either may be absent.

    Args:
        level (int): label level, 1 for the fewest labels.
        label_share (float): share of the labels.
    """

    task: str
    method: str
    level: int
    label_share: float
    measured: Summary | None
    paper: PaperCell | None

    @property
    def success(self) -> float | None:
        """Measured success in 0..1, None if no seed is done."""
        return None if self.measured is None else self.measured.mean("success")

    @property
    def text(self) -> str:
        """Measured success and its interval in percent, number of rollouts and, in brackets, the paper's mean."""
        if self.success is None:
            here = "failed" if self.measured is not None and self.measured.failed else "not run"
        else:
            interval = self.measured.measures["success"]
            lost = f", {len(self.measured.failed)} failed" if self.measured.failed else ""
            here = f"{100 * self.success:.1f} ({100 * interval.low:.0f}-{100 * interval.high:.0f}){lost}"
        return here if self.paper is None else f"{here} [{self.paper.text}]"


def paper_entries(rows: Sequence[Mapping[str, Any]]) -> list[Entry]:
    """Cells of all tasks, methods and levels that occur among some rows, those that were not run included.

    Cells at shares that are no label level of their task are left out.

    Raises:
        ValueError: as :func:`~torchrl_koap.studies.summary.summarise`.
    """
    found: dict[tuple[str, int, str], Summary] = {}
    for item in summarise(rows):
        levels = _levels_of(item.task)
        if item.labels in levels:
            found[item.task, levels.index(item.labels) + 1, item.method] = item
    tasks = list(dict.fromkeys(task for task, _, _ in found))
    methods = list(dict.fromkeys(method for _, _, method in found))
    return [
        Entry(task, method, level, share, found.get((task, level, method)), paper_cell(task, method, level))
        for task in tasks
        for level, share in enumerate(_levels_of(task), start=1)
        if any(key[:2] == (task, level) for key in found)
        for method in methods
    ]


def _levels_of(task: str) -> tuple[float, ...]:
    return TASKS[task].label_levels if task in TASKS else paper_levels(task)


def layout_rows(entries: Sequence[Entry]) -> list[dict[str, str]]:
    """The table as text: a row per task and level, a column per method."""
    lines: dict[tuple[str, int], dict[str, str]] = {}
    for entry in entries:
        line = lines.setdefault(
            (entry.task, entry.level), {"task": entry.task, "level": f"{entry.level} ({percent(entry.label_share)})"}
        )
        line[entry.method] = entry.text
    return list(lines.values())


def above_the_paper(entries: Sequence[Entry], method: str = "koap") -> tuple[int, int]:
    """In how many cells a method succeeds more often than the paper's, of how many that both have."""
    both = [entry for entry in entries if entry.method == method and entry.paper and entry.success is not None]
    return sum(entry.success > entry.paper.success for entry in both), len(both)


def default_entries(entries: Sequence[Entry]) -> list[Entry]:
    """Cells of the method that a task is trained with unless told otherwise, under one name, beside the paper's KOAP.

    Their method is :data:`DEFAULT`; tasks that nobody registered have none.
    """
    own = [entry for entry in entries if (task := TASKS.get(entry.task)) and entry.method == task.defaults.method]
    return [replace(entry, method=DEFAULT, paper=paper_cell(entry.task, "koap", entry.level)) for entry in own]


def average_over_tasks(entries: Sequence[Entry]) -> dict[str, list[tuple[int, float, float, float]]]:
    """Success averaged over the tasks at every level, by method: level, mean and the ends of its 95 % interval.

    A method has a point where every task has a cell of it that is done, so that all points are of the same tasks. Its
    interval combines the Wilson intervals of the cells by the squares of their halves (Newcombe's method).
    """
    lines: dict[str, list[tuple[int, float, float, float]]] = {}
    number = len({entry.task for entry in entries})
    for method in dict.fromkeys(entry.method for entry in entries):
        for level in sorted({entry.level for entry in entries}):
            cells = [entry for entry in entries if (entry.method, entry.level) == (method, level)]
            if len(cells) < number or any(entry.success is None for entry in cells):
                continue
            mean = sum(entry.success for entry in cells) / len(cells)
            ends = [entry.measured.measures["success"] for entry in cells]
            below = math.sqrt(sum((end.mean - end.low) ** 2 for end in ends)) / len(cells)
            above = math.sqrt(sum((end.high - end.mean) ** 2 for end in ends)) / len(cells)
            lines.setdefault(method, []).append((level, mean, mean - below, mean + above))
    return lines


def draw_average(entries: Sequence[Entry], path: str | Path) -> Path:
    """Draws success averaged over tasks against the label level; tasks' default methods together have a line too.

    Raises:
        ValueError: if there is no level at which a method is done in every task.
    """
    if len({entry.method for entry in entries if default_entries([entry])}) > 1:  # the paper's line is koap's own
        entries = [*(replace(entry, paper=None) for entry in default_entries(entries)), *entries]
    averages = average_over_tasks(entries)
    paper: dict[str, list[tuple[int, float]]] = {}
    for method, points in averages.items():
        for level, *_ in points:
            cells = [entry.paper for entry in entries if (entry.method, entry.level) == (method, level)]
            if all(cells):
                paper.setdefault(method, []).append((level, sum(cell.success for cell in cells) / len(cells)))
    return plot_average(averages, paper, list(dict.fromkeys(entry.task for entry in entries)), path)


def write_paper_layout(folder: str | Path, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Writes ``paper_table.md`` and the picture of success averaged over tasks into a folder.

    Returns:
        dict: ``rows`` of the table, a ``sentence`` on KOAP and the paper's, and ``picture``, the path of the picture
        below the folder, None if nothing is done that could be averaged.
    """
    folder, entries = Path(folder), paper_entries(rows)
    table = layout_rows(entries)
    above, both = above_the_paper(entries)
    sentence = f"KOAP succeeds more often than the paper's KOAP in {above} of {both} cells." if both else ""
    with replacing_file(folder / "paper_table.md") as aside:
        aside.write_text(f"{as_markdown(table)}\n{sentence}\n", encoding="utf-8")
    picture = AVERAGE if average_over_tasks(entries) else None
    if picture is not None:
        draw_average(entries, folder / picture)
    return {"rows": table, "sentence": sentence, "picture": picture}
