# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes the page of the architecture: subpackages, their files, and the imports that the test allows."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from pages import ROOT, heading, table, write_file, write_page

PACKAGE = ROOT / "torchrl_koap"
SOURCE = ROOT / "tests" / "test_imports_point_one_way.py"
WIDTH, ROW, BOX = 640, 64, 104


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: write_design_page())
    return {"parallel_read_safe": True}


def write_design_page() -> None:
    """Writes ``generated/design``: the drawing, the rules and the files of every subpackage."""
    allowed = may_import()
    write_file("rooms.svg", drawing(allowed))
    blocks = []
    for room in (name for name in allowed if (PACKAGE / name).is_dir()):
        files = [path for path in sorted((PACKAGE / room).rglob("*.py")) if path.name != "__init__.py"]
        rows = [(f"``{path.relative_to(PACKAGE)}``", first_sentence(path)) for path in files]
        blocks += [
            heading(room, 1),
            first_sentence(PACKAGE / room / "__init__.py"),
            table(("file", "what it holds"), rows),
        ]
    rules = [
        (f"``{room}``", ", ".join(sorted(others - {room, "__version__"})) or "nothing of the package")
        for room, others in allowed.items()
    ]
    write_page(
        "design",
        heading("Architecture"),
        "An arrow points from a subpackage to one that it may import. Imports by way of another subpackage are left "
        "out of the drawing. A test reads every import and fails where one points upward. So ``import "
        "torchrl_koap.modules`` never loads a simulator.",
        ".. raw:: html\n   :file: rooms.svg",
        table(("subpackage", "may import"), rules),
        *blocks,
    )


def may_import() -> dict[str, set[str]]:
    """Returns the test's table of allowed imports; runs only the assignments of that file."""
    found: dict[str, Any] = {}
    for node in ast.parse(SOURCE.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) in ("BASE", "TRAINING", "MAY_IMPORT"):
            exec(compile(ast.Module([node], []), SOURCE.name, "exec"), found)
    return found["MAY_IMPORT"]


def first_sentence(path: Path) -> str:
    """Returns the first line of a file's docstring."""
    return (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n")[0]


def floors(allowed: dict[str, set[str]]) -> dict[str, int]:
    """Returns the level of every subpackage: one above the highest level that it may import."""
    level: dict[str, int] = {}
    while len(level) < len(allowed):
        for room, others in allowed.items():
            below = (others & allowed.keys()) - {room}
            if room not in level and below <= level.keys():
                level[room] = 1 + max((level[other] for other in below), default=-1)
    return level


def drawing(allowed: dict[str, set[str]]) -> str:
    """Returns an SVG in the colours of the surrounding page."""
    level = floors(allowed)
    top = max(level.values())
    place = {}
    for floor in range(top + 1):
        rooms = [room for room in allowed if level[room] == floor]
        for index, room in enumerate(rooms):
            place[room] = (WIDTH * (index + 1) / (len(rooms) + 1), 30 + ROW * (top - floor))
    lines = []
    for room, others in allowed.items():
        below = (others & allowed.keys()) - {room}
        direct = {other for other in below if not any(other in allowed[third] - {third} for third in below - {other})}
        for other in sorted(direct):
            (x0, y0), (x1, y1) = place[room], place[other]
            lines.append(
                f'<line x1="{x0:.0f}" y1="{y0 + 15:.0f}" x2="{x1:.0f}" y2="{y1 - 17:.0f}" marker-end="url(#tip)"/>'
            )
    boxes = [
        f'<rect x="{x - BOX / 2:.0f}" y="{y - 15:.0f}" width="{BOX}" height="30" rx="6"/>'
        f'<text x="{x:.0f}" y="{y + 5:.0f}">{room}</text>'
        for room, (x, y) in place.items()
    ]
    return (
        f'<svg class="drawing" viewBox="0 0 {WIDTH} {60 + ROW * top}" role="img" aria-label="subpackages and imports">'
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0 L8 4 L0 8 z"/></marker></defs>' + "".join((*lines, *boxes)) + "</svg>\n"
    )
