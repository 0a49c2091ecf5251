# This source code is licensed under the MIT license found in the LICENSE file.
"""Pages from templates: numbers and keys in words, and the one environment that escapes everything that comes in.

A page is one file beside its pictures: style and script are inside, nothing is fetched from elsewhere.
"""

from __future__ import annotations

import math
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
    """Returns a single value of a JSON file as text, by its key, which may be a seed's; the template escapes it."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value) if key in _PLAIN else f"{value:,}"
    if isinstance(value, float):
        if not math.isfinite(value):
            return "not a number" if math.isnan(value) else "infinite"
        return f"{value:.4g}"
    return str(value)


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
    """Returns every key of some mappings, in the order in which they first occur."""
    return list(dict.fromkeys(name for row in rows for name in row))


@cache
def templates() -> Environment:
    """Returns the templates of this package; names that are not handed in are errors, everything else is escaped."""
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
    """Fills a template of ``reports/templates`` with what it names, writes the page aside first, returns its file."""
    path, page = Path(path), templates().get_template(template).render(**content)
    with replacing_file(path) as aside:
        aside.write_text(page, encoding="utf-8")
    return path
