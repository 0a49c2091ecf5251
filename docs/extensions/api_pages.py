# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes a page per subpackage with the public classes and functions of its modules, from their docstrings."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from pages import ROOT, heading, table, toctree, write_page

PACKAGE = ROOT / "torchrl_koap"
ROOMS = (
    *("tasks", "data", "modules", "objectives", "envs", "vision", "runs", "training", "evaluation", "reports"),
    "studies",
)
BASE = ("keys", "lookup", "files")


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: write_api_pages(quick=app.tags.has("quick")))
    return {"parallel_read_safe": True}


def write_api_pages(quick: bool = False) -> None:
    """Writes ``generated/api``: an index, a page per subpackage and, unless ``quick``, a page per module."""
    for room in ROOMS:
        files = [path for path in sorted((PACKAGE / room).rglob("*.py")) if path.name != "__init__.py"]
        modules = [path for path in files if public_names(path)]
        for path in modules:
            write_module(path)
        link = "``{}``" if quick else ":doc:`{}`"
        rows = [
            (link.format(name_of(path)), ", ".join(f"``{name}``" for name in public_names(path))) for path in modules
        ]
        write_page(
            f"api/{room}",
            heading(f"torchrl_koap.{room}"),
            (ast.get_docstring(ast.parse((PACKAGE / room / "__init__.py").read_text())) or "").split("\n\n")[0],
            table(("module", "what it offers"), rows),
            "" if quick else toctree((entry(name_of(path), f"torchrl_koap.{room}.") for path in modules), hidden=True),
        )
    for name in BASE:
        write_module(PACKAGE / f"{name}.py")
    write_page(
        "api/index",
        heading("Python API"),
        "Every public class and function, by the file it lives in. What is used most is also at the top, as "
        "``torchrl_koap.train`` or ``torchrl_koap.Agent``.",
        toctree((*ROOMS, *(f"torchrl_koap.{name}" for name in BASE if not quick))),
    )


def entry(page: str, prefix: str) -> str:
    """Formats an entry of the navigation; its text is the name of the page without the prefix."""
    return f"{page.removeprefix(prefix)} <{page}>"


def name_of(path: Path) -> str:
    """Returns the dotted name of a file."""
    return ".".join(("torchrl_koap", *path.relative_to(PACKAGE).with_suffix("").parts))


def public_names(path: Path) -> list[str]:
    """Returns the public classes and functions that a file defines and documents."""
    nodes = ast.parse(path.read_text(encoding="utf-8")).body
    kinds = (ast.ClassDef, ast.FunctionDef)
    return [n.name for n in nodes if isinstance(n, kinds) and not n.name.startswith("_") and ast.get_docstring(n)]


def write_module(path: Path) -> None:
    """Writes the page of one module."""
    name = name_of(path)
    write_page(f"api/{name}", heading(name), f".. automodule:: {name}\n   :members:\n   :show-inheritance:")
