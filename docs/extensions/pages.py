# This source code is licensed under the MIT license found in the LICENSE file.
"""What all generated pages share: where they are written, headings, tables."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from torchrl_koap.evaluation.statistics import wilson_interval

ROOT = Path(__file__).resolve().parents[2]
GENERATED = ROOT / "docs" / "generated"
MARKS = "=-~"


def write_page(name: str, *blocks: str) -> Path:
    """Writes a page if its text has changed, so that unchanged pages are not read again.

    Args:
        name (str): path below ``docs/generated`` without its ending.
        *blocks (str): its paragraphs.
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
    """A heading of a level, 0 for the title of the page."""
    return f"{text}\n{MARKS[level] * max(len(text), 3)}"


def table(head: Sequence[str], rows: Iterable[Sequence[object]], widths: str = "auto") -> str:
    """A table; empty if it has no rows."""
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
    """A list of pages, named relative to the page that holds it."""
    options = [f"   :maxdepth: {depth}"] + (["   :hidden:"] if hidden else [])
    return "\n".join([".. toctree::", *options, "", *(f"   {page}" for page in pages)])


def code(text: str, language: str = "text") -> str:
    """A literal block."""
    body = "\n".join(f"   {line}".rstrip() for line in text.rstrip().splitlines())
    return f".. code-block:: {language}\n\n{body}"


def read_rows(name: str) -> list[dict[str, str]]:
    """Rows of a file of measured figures, ``benchmarks/results/NAME.csv``."""
    with (ROOT / "benchmarks" / "results" / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def success(successes: str | int, trials: str | int) -> str:
    """A success rate with its 95 % interval and the number of rollouts, in percent; empty without successes."""
    if successes == "":
        return ""
    low, high = wilson_interval(int(successes), int(trials))
    return f"{100 * int(successes) / int(trials):.1f} % ({100 * low:.0f}-{100 * high:.0f}) of {trials}"


def planner_rows(**wanted: str) -> list[dict[str, str]]:
    """Rows of ``planner_ablations.csv`` with a learned controller, and with these values."""
    rows = [row for row in read_rows("planner_ablations") if row["controller"] == "learned"]
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def execution(row: dict[str, str]) -> str:
    """Denoiser, candidates, training seed and note of a row of ``planner_ablations.csv``."""
    many = f"{row['candidates']} candidates" if row["candidates"] not in ("", "1") else ""
    seed = f"training seed {row['training_seed']}"
    return ", ".join(part for part in (row["denoiser"].split()[0], many, seed, row["note"]) if part)


def escape(text: str) -> str:
    """Plain text in which nothing is markup."""
    for mark in ("\\", "*", "`", "|", "_"):
        text = text.replace(mark, "\\" + mark)
    return text
