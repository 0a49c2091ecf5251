# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes a page per tutorial: its text and code, then the output and picture saved by ``make tutorials``.

Tutorials are not run here, because they take longer than building the site. The output holds a hash of the code. If the
hashes differ, the page states that the code has changed.
"""

from __future__ import annotations

import ast
import hashlib
import shutil
import tokenize
from pathlib import Path
from typing import Any

from pages import GENERATED, ROOT, code, heading, table, toctree, write_page

FOLDER, OUTPUTS = ROOT / "tutorials", ROOT / "docs" / "outputs"
# reading order
ORDER = (
    "few_labels",
    "own_robot",
    "modules_by_hand",
    "gymnasium_robot",
    "compare_controllers",
    "planners",
    "own_task",
    "label_next",
    "scooping",
    "label_curve",
)
FIRST = 4  # number of tutorials; the others form the gallery
DIGEST = "# code: "


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: write_tutorial_pages())
    return {"parallel_read_safe": True}


def write_tutorial_pages() -> None:
    """Writes ``generated/tutorials``: an index and a page per tutorial."""
    found = {path.stem for path in FOLDER.glob("*.py")}
    if found != set(ORDER):
        raise ValueError(f"tutorials and their order differ: {sorted(found ^ set(ORDER))}")
    rows = []
    for name in ORDER:
        write_tutorial(FOLDER / f"{name}.py")
        title, about = introduction(FOLDER / f"{name}.py")
        points = [line.lstrip("* ") for line in about.splitlines() if line.startswith("* ")]
        rows.append((f":doc:`{name}`", title, points[0].rstrip(",.") if points else ""))
    write_page(
        "tutorials/index",
        heading("Tutorials"),
        "Each is a script that prints its numbers and ends with a picture. ``make tutorials`` runs them all and keeps "
        "the output that these pages show. Read the first four in this order.",
        table(("script", "title", "first point"), rows[:FIRST]),
        heading("Example gallery", 1),
        table(("script", "title", "first point"), rows[FIRST:]),
        toctree(ORDER, hidden=True),
    )


def digest(path: Path) -> str:
    """Returns a short hash of a tutorial's code without docstring, comments and layout, which need no new run."""
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    after = iter(lines[ast.parse("".join(lines)).body[0].end_lineno :])
    signs = {tokenize.COMMENT: "", tokenize.INDENT: "{", tokenize.DEDENT: "}"}
    kept = "".join(signs.get(kind, text) for kind, text, *_ in tokenize.generate_tokens(lambda: next(after, "")))
    return hashlib.sha256("".join(kept.split()).encode()).hexdigest()[:12]  # tokens of f-strings depend on the Python


def introduction(path: Path) -> tuple[str, str]:
    """Returns title and text of the docstring."""
    lines = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").splitlines()
    return lines[0].rstrip("."), "\n".join(lines[2:]).strip()


def cells(path: Path) -> list[tuple[str, str]]:
    """Splits a script after its docstring into pieces: ``("text" or "code", content)``."""
    source = path.read_text(encoding="utf-8")
    end = ast.parse(source).body[0].end_lineno or 0
    pieces: list[tuple[str, str]] = []
    for block in "\n".join(source.splitlines()[end:]).split("\n# %%"):
        lines = block.lstrip("\n").splitlines()
        words = []
        while lines and lines[0].lstrip().startswith("#"):
            words.append(lines.pop(0).lstrip()[1:].removeprefix(" "))
        if words and any(words):
            pieces.append(("text", "\n".join(words)))
        if any(lines):
            pieces.append(("code", "\n".join(lines).strip("\n")))
    return pieces


def write_tutorial(path: Path) -> None:
    """Writes the page of one tutorial."""
    title, about = introduction(path)
    blocks = [heading(title), about]
    for kind, content in cells(path):
        content = content.replace("%% ", "").strip("\n") if kind == "text" else content
        blocks.append(code(content, "python") if kind == "code" else underlined(content))
    blocks += [heading("Output", 1), *output_of(path)]
    write_page(f"tutorials/{path.stem}", *blocks)


def underlined(text: str) -> str:
    """Adapts the underlines of a cell's headings to the length of their text."""
    lines = text.splitlines()
    for index, line in enumerate(lines):
        if line and set(line) == {"-"} and index:
            lines[index] = "-" * len(lines[index - 1])
    return "\n".join(lines)


def output_of(path: Path) -> list[str]:
    """Returns the output and picture that ``make tutorials`` saved last."""
    printed, picture = OUTPUTS / f"{path.stem}.txt", OUTPUTS / f"{path.stem}.png"
    blocks = []
    if not printed.exists():
        return ["Not run yet: ``make tutorials``."]
    first, *lines = printed.read_text(encoding="utf-8").splitlines()
    if first != DIGEST + digest(path):
        blocks.append(".. note:: The code has changed since; ``make tutorials`` renews the output.")
    blocks.append(code("\n".join(lines), "text"))
    if picture.exists():
        target = GENERATED / "tutorials" / picture.name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(picture, target)
        blocks.append(f".. image:: {picture.name}\n   :class: picture\n   :alt: picture of {path.stem}")
    return blocks
