# This source code is licensed under the MIT license found in the LICENSE file.
"""Both tables of the paper as data, 165 cells, next to measured cells in the same layout.

A cell is a mean success and the number after the paper's ``+-``, presumably the standard deviation over seeds. The
paper's Stacking, which counts one box, is ``stacking_unobserved_joints`` (its state) of
:data:`~torchrl_koap.tasks.TASKS` and, with the joints observed, ``stacking_1``. Cells that the paper lacks are None.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from torchrl_koap.files import replacing_file
from torchrl_koap.reports.pictures import FOLDER
from torchrl_koap.studies.plots import Average, plot_average
from torchrl_koap.studies.table import Summary, as_markdown, percent, summarise
from torchrl_koap.tasks import TASKS

AVERAGE = f"{FOLDER}/average.png"


@dataclass(frozen=True)
class PaperCell:
    """A cell of the paper's tables: mean success in 0..1 and the number after the ``+-``; level 1 has fewest labels."""

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


def paper_cells(table: int) -> list[PaperCell]:
    """Returns all cells of table 1 (methods) or 2 (variants), for every task that stands for one of the paper's."""
    content = json.loads(files("torchrl_koap.studies").joinpath("paper_results.json").read_text(encoding="utf-8"))
    return [
        PaperCell(task, method, level, shares[level - 1] / 100, round(success / 100, 4), round(spread / 100, 4))
        for name, methods in content["tables"][str(table)].items()
        for task in content["tasks"][name]["tasks"]
        for method, cells in methods.items()
        for shares in (content["tasks"][name]["label_percent"],)
        for level, (success, spread) in enumerate(cells, start=1)
    ]


@functools.cache
def all_paper_cells() -> dict[tuple[str, str, int], PaperCell]:
    """Returns the cells of both tables by task, method and level; table 1 overrides table 2."""
    return {(cell.task, cell.method, cell.level): cell for cell in [*paper_cells(2), *paper_cells(1)]}


def paper_points(task: str) -> dict[str, list[tuple[float, float]]]:
    """Returns the cells of a task in both tables, each once: label shares and successes in 0..1 by method."""
    points: dict[str, list[tuple[float, float]]] = {}
    for cell in all_paper_cells().values():
        if cell.task == task:
            points.setdefault(cell.method, []).append((cell.label_share, cell.success))
    return points


@dataclass(frozen=True)
class Entry:
    """A measured cell, pooled over seeds, and the paper's; either may be absent."""

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
        """Measured success and its interval in percent and, in brackets, the paper's success and spread."""
        if self.success is None:
            here = "failed" if self.measured is not None and self.measured.failed else "not run"
        else:
            interval = self.measured.measures["success"]
            lost = f", {len(self.measured.failed)} failed" if self.measured.failed else ""
            here = f"{100 * self.success:.1f} ({100 * interval.low:.0f}-{100 * interval.high:.0f}){lost}"
        return here if self.paper is None else f"{here} [{self.paper.text}]"


def paper_entries(rows: Sequence[Mapping[str, Any]]) -> list[Entry]:
    """Returns entries for all tasks, methods and levels that occur in rows, cells that were not run included.

    Cells of tasks that are not registered, and at shares that are not a label level, are left out.
    """
    found: dict[tuple[str, int, str], Summary] = {}
    for item in summarise(rows):
        levels = TASKS[item.task].label_levels if item.task in TASKS else ()
        if item.labels in levels:
            found[item.task, levels.index(item.labels) + 1, item.method] = item
    tasks, methods = (list(dict.fromkeys(names)) for names in ([t for t, _, _ in found], [m for _, _, m in found]))
    paper = all_paper_cells()
    return [
        Entry(task, method, level, share, found.get((task, level, method)), paper.get((task, method, level)))
        for task in tasks
        for level, share in enumerate(TASKS[task].label_levels, start=1)
        if any(key[:2] == (task, level) for key in found)
        for method in methods
    ]


def layout_rows(entries: Sequence[Entry]) -> list[dict[str, str]]:
    """Returns the table as text: a row per task and level, a column per method."""
    lines: dict[tuple[str, int], dict[str, str]] = {}
    for entry in entries:
        head = {"task": entry.task, "level": f"{entry.level} ({percent(entry.label_share)})"}
        lines.setdefault((entry.task, entry.level), head)[entry.method] = entry.text
    return list(lines.values())


def above_the_paper(entries: Sequence[Entry]) -> tuple[int, int]:
    """Counts the cells in which KOAP succeeds more often than the paper's, and the cells that both have."""
    both = [entry for entry in entries if entry.method == "koap" and entry.paper and entry.success is not None]
    return sum(entry.success > entry.paper.success for entry in both), len(both)


def average_over_tasks(entries: Sequence[Entry]) -> dict[str, list[Average]]:
    """Averages success over the tasks at every level, by method.

    A method has a point only if its cell is done for every task, so that all points average the same tasks. The
    interval combines the Wilson intervals of the cells: squares of their halves add up (Newcombe's method).
    """
    lines: dict[str, list[Average]] = {}
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
            paper = [entry.paper.success for entry in cells if entry.paper]
            theirs = sum(paper) / len(paper) if len(paper) == len(cells) else None
            lines.setdefault(method, []).append((level, mean, mean - below, mean + above, theirs))
    return lines


def draw_average(entries: Sequence[Entry], path: str | Path) -> None:
    """Draws success averaged over tasks against the label level, measured and of the paper."""
    plot_average(average_over_tasks(entries), len({entry.task for entry in entries}), path)


def write_paper_layout(folder: str | Path, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Writes ``paper_table.md`` and the picture of success averaged over several tasks into a folder.

    Returns the table's ``rows``, a ``sentence`` that compares KOAP with the paper's, and the path of the ``picture``,
    None if there is nothing to average. Writes nothing if no cell is at a label level.
    """
    folder, entries = Path(folder), paper_entries(rows)
    table = layout_rows(entries)
    above, both = above_the_paper(entries)
    sentence = f"KOAP succeeds more often than the paper's KOAP in {above} of {both} cells." if both else ""
    numbers = sorted({entry.measured.episodes for entry in entries if entry.success is not None})
    sentence += f" Rollouts per cell (n): {', '.join(map(str, numbers))}; table.md has that of each." if numbers else ""
    if table:
        with replacing_file(folder / "paper_table.md") as aside:
            aside.write_text(f"{as_markdown(table)}\n{sentence}\n", encoding="utf-8")
    picture = AVERAGE if len({entry.task for entry in entries}) > 1 and average_over_tasks(entries) else None
    if picture is not None:
        draw_average(entries, folder / picture)
    return {"rows": table, "sentence": sentence, "picture": picture}
