# This source code is licensed under the MIT license found in the LICENSE file.
"""Helper functions of all generated pages: files, headings, tables, measured figures."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from torchrl_koap.evaluation.statistics import wilson_interval

ROOT = Path(__file__).resolve().parents[2]
GENERATED = ROOT / "docs" / "generated"
MARKS = "=-~"


def write_page(name: str, *blocks: str) -> Path:
    """Writes a page if its text has changed, so that Sphinx does not read unchanged pages again.

    Args:
        name (str): path below ``docs/generated`` without its ending.
        *blocks (str): paragraphs of the page.
    """
    return write_file(f"{name}.rst", "\n\n".join(block.rstrip() for block in blocks if block) + "\n")


def write_file(name: str, text: str) -> Path:
    """Writes a file below ``docs/generated`` if its text has changed."""
    path = GENERATED / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
    return path


def heading(text: str, level: int = 0) -> str:
    """Formats a heading; level 0 is the title of the page."""
    return f"{text}\n{MARKS[level] * max(len(text), 3)}"


def table(head: Sequence[str], rows: Iterable[Sequence[object]], widths: str = "auto") -> str:
    """Formats a table; an empty text if it has no rows."""
    rows = [[str(cell) for cell in row] for row in rows]
    if not rows:
        return ""
    lines = [".. list-table::", "   :header-rows: 1", f"   :widths: {widths}", "   :class: wide", ""]
    for row in (list(head), *rows):
        for index, cell in enumerate(row):
            first, *rest = cell.splitlines() or [""]
            lines.append(f"   {'*' if index == 0 else ' '} - {first}".rstrip())
            lines += [f"       {line}".rstrip() for line in rest]
    return "\n".join(lines)


def toctree(pages: Iterable[str], *, depth: int = 1, hidden: bool = False) -> str:
    """Formats a list of pages, named relative to the page that includes it."""
    options = [f"   :maxdepth: {depth}"] + (["   :hidden:"] if hidden else [])
    return "\n".join([".. toctree::", *options, "", *(f"   {page}" for page in pages)])


def code(text: str, language: str = "text") -> str:
    """Formats a literal block."""
    body = "\n".join(f"   {line}".rstrip() for line in text.rstrip().splitlines())
    return f".. code-block:: {language}\n\n{body}"


def read_rows(name: str) -> list[dict[str, str]]:
    """Reads the rows of a file of measured figures, ``benchmarks/results/NAME.csv``."""
    with (ROOT / "benchmarks" / "results" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def success(successes: str | int, trials: str | int) -> str:
    """Formats a success rate in percent with its 95 % interval and the rollouts; empty without successes."""
    if successes == "":
        return ""
    low, high = wilson_interval(int(successes), int(trials))
    return f"{100 * int(successes) / int(trials):.1f} % ({100 * low:.0f}-{100 * high:.0f}) of {trials}"


def benchmark_rows(**wanted: str) -> list[dict[str, str]]:
    """Pools cells of the current comparison over all seeds; ``wanted`` selects tasks or methods."""
    found: dict[tuple[str, ...], dict[str, str]] = {}
    for row in (*read_rows("cells/table_1"), *read_rows("cells/table_2")):
        if row["status"] != "done" or any(row[name] != value for name, value in wanted.items()):
            continue
        cell = found.setdefault((row["task"], row["method"], row["labels"]), row | {"successes": "0", "episodes": "0"})
        for count in ("successes", "episodes"):
            cell[count] = str(int(cell[count]) + int(row[count]))
    return list(found.values())


def measured_table(rows: Iterable[dict[str, str]], first: str) -> str:
    """Formats the success of cells of :func:`benchmark_rows`; the column ``first`` is their task or method."""
    cells = (
        (f"``{row[first]}``", f"{100 * float(row['labels']):g} %", success(row["successes"], row["episodes"]))
        for row in rows
    )
    return table((first, "labelled", "success (95 %)"), cells)


def escape(text: str) -> str:
    """Escapes the markup characters of plain text."""
    for mark in ("\\", "*", "`", "|", "_"):
        text = text.replace(mark, "\\" + mark)
    return text
