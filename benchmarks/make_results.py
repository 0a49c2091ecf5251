# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes docs/results, docs/appendix, docs/reference/versions.md, the results of the README and their pictures.

    python benchmarks/make_results.py           # write
    python benchmarks/make_results.py --check   # compare with what is committed, exit 1 if it differs

Figures are in ``benchmarks/results/*.csv``; the text of each page is a template in the same folder. Pages of
docs/results extend ``page.jinja``, which defines their sections. A number in a template must occur in a CSV file that
its page links (tests/docs/test_results_form.py). Intervals are computed from n and successes.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ground_rows
import page_rows
import paper_rows
import pictures
import tables
import tyro
import unlabelled_rows
from jinja2 import Environment, FileSystemLoader, StrictUndefined

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- results: made by benchmarks/make_results.py -->", "<!-- end of results -->"
ORPHAN = "---\norphan: true\n---\n\n"  # front matter of pages outside the navigation


def pages() -> dict[Path, str]:
    """Renders every generated text, by its path relative to the repository's root."""
    environment = Environment(
        loader=FileSystemLoader(tables.SOURCE), undefined=StrictUndefined, trim_blocks=True, keep_trailing_newline=True
    )
    for module in (tables, paper_rows, unlabelled_rows, ground_rows, page_rows):
        environment.globals.update(vars(module))
    made = {}
    for template in sorted(tables.SOURCE.rglob("*.md.jinja")):
        name = template.name.removesuffix(".jinja")
        text = environment.get_template(str(template.relative_to(tables.SOURCE))).render()
        if name == "readme.md":
            whole = (ROOT / "README.md").read_text(encoding="utf-8")
            before, rest = whole.split(BEGIN)
            made[Path("README.md")] = f"{before}{BEGIN}\n{text.strip()}\n{END}{rest.split(END)[1]}"
        else:
            folder = "results" if template.parent == tables.SOURCE else template.parent.name
            made[Path("docs") / folder / name] = ORPHAN * (folder == "appendix") + text
    return made


def main(*, check: bool = False) -> int:
    """Writes every page and picture made from committed figures; returns the exit status.

    Args:
        check: write nothing, compare with the committed pages.
    """
    stale = []
    for path, text in pages().items():
        there = (ROOT / path).read_text(encoding="utf-8") if (ROOT / path).exists() else None
        if there != text:
            stale.append(path)
            if not check:
                (ROOT / path).parent.mkdir(parents=True, exist_ok=True)
                (ROOT / path).write_text(text, encoding="utf-8")
    if check:
        print("\n".join(f"{path} differs from what the figures give" for path in stale) or "every page is up to date")
        return int(bool(stale))
    drawn = pictures.draw_all(ROOT / "docs" / "pictures")
    print("\n".join(f"wrote {path}" for path in [*stale, *(path.relative_to(ROOT) for path in drawn)]))
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
