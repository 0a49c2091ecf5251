# This source code is licensed under the MIT license found in the LICENSE file.
"""What a command says in the end: a table of its result, or one line that says why there is none."""

from __future__ import annotations

import contextlib
import json
import sys
from collections.abc import Iterator, Mapping
from typing import Any

_LONG = ("episode", "action_errors")
HINT = "KOAP_TRACEBACK=1 shows where"


def one_line(error: BaseException) -> str:
    """The message of an error, the problems it lists one after the other."""
    message = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    said = "; ".join(line.strip().removeprefix("- ") for line in message.splitlines() if line.strip()).replace(
        ":;", ":"
    )
    if isinstance(error, MemoryError):
        return f"out of memory{f': {said}' if said else ''}; try fewer episodes, or smaller batches"
    return said or type(error).__name__


def complain(message: str) -> None:
    """Writes one line to stderr, if that can be written to."""
    with contextlib.suppress(OSError, ValueError):  # a full device, a closed one
        sys.stderr.write(f"koap: {message}\n")
        sys.stderr.flush()


def show(result: Any) -> None:
    """Prints a result: a table of names and values, without the rows of single episodes or action columns."""
    if not isinstance(result, Mapping):
        print(result)
        return
    lines = [line for key, value in result.items() if key not in _LONG for line in _lines(key, value)]
    width = min(max((len(name) for name, _ in lines), default=0), 45)
    for name, text in lines:
        print(f"{name:<{width}}  {text}")


def _lines(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """A line per value; a mapping of plain values is one line, a nested one a line for each of its entries."""
    if isinstance(value, Mapping) and any(isinstance(entry, Mapping) for entry in value.values()):
        for key, entry in value.items():
            yield from _lines(f"{name} {key}", entry)
    elif isinstance(value, Mapping):
        yield name, json.dumps({key: _short(entry) for key, entry in value.items()})
    else:
        yield name, _short(value)


def _short(value: Any) -> Any:
    if isinstance(value, list):
        return [_short(entry) for entry in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value
