# This source code is licensed under the MIT license found in the LICENSE file.
"""Fills page templates: formats numbers and keys; the only template environment, which escapes all input.

A page is one file next to its pictures, with style and script inside; it loads nothing from elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from torchrl_koap.files import replacing_file

_UNITS = {"_ms": "ms", "_mm": "mm", "_mrad": "mrad", "_hz": "Hz", "_seconds": "s"}
_PLAIN = ("seed", "mode")
_WORDS = {"labels_read_outside_budget": "labels read outside the budget, for evaluation only"}


def show(value: Any, key: str = "") -> str:
    """Formats a single value of a JSON file by its key (seeds without commas); the template escapes it."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value) if key in _PLAIN else f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def label(key: Any) -> str:
    """Returns a key as words, with its unit."""
    key = str(key)
    if key in _WORDS:
        return _WORDS[key]
    for ending, unit in _UNITS.items():
        if key.endswith(ending) and len(key) > len(ending):
            return f"{key[: -len(ending)].replace('_', ' ')} ({unit})"
    return key.replace("_", " ")


def columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Returns the keys of all rows, in the order of their first occurrence."""
    return list(dict.fromkeys(name for row in rows for name in row))


@cache
def templates() -> Environment:
    """Returns the template environment of this package; missing names are errors, all input is escaped."""
    environment = Environment(
        loader=PackageLoader("torchrl_koap.reports"),
        autoescape=lambda name: name is None or name.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters.update(show=show, label=label, columns=columns)
    return environment


def write_page(template: str, path: str | Path, **content: Any) -> Path:
    """Fills a template of ``reports/templates`` with ``content``, writes the page atomically, returns its path."""
    path, page = Path(path), templates().get_template(template).render(**content)
    with replacing_file(path) as aside:
        aside.write_text(page, encoding="utf-8")
    return path
