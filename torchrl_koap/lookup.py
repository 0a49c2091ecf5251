# This source code is licensed under the MIT license found in the LICENSE file.
"""Looking names up: in a table, where an unknown one suggests the nearest, and behind import strings."""

from __future__ import annotations

import difflib
import functools
import importlib
import importlib.util
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any


def lookup(table: Mapping[str, Any] | Collection[str], name: object, what: str) -> Any:
    """Returns the entry ``name`` of a table, or ``name`` itself where the table is a plain collection of names.

    Args:
        table (mapping or collection of str): what there is.
        name (object): what is asked for; anything that is not a string of the table is unknown.
        what (str): what the names stand for; the message begins with it.

    Raises:
        ValueError: if the name is unknown. The message suggests the nearest name, or else lists them all.

    Examples:
        >>> from torchrl_koap.lookup import lookup
        >>> lookup({"dense": 1, "diagonal": 2}, "diagnoal", "structure")
        Traceback (most recent call last):
        ...
        ValueError: unknown structure 'diagnoal'; did you mean 'diagonal'?
    """
    if isinstance(name, str) and name in table:
        return table[name] if isinstance(table, Mapping) else name
    lowered = {known.lower(): known for known in table}
    near = difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5) if isinstance(name, str) else []
    hint = f"did you mean {lowered[near[0]]!r}?" if near else f"known: {', '.join(table)}"
    raise ValueError(f"unknown {what} {name!r}; {hint}")


def resolve(reference: Any, what: str) -> Any:
    """Imports the object that an import string names; anything that is no string is returned as it is.

    Args:
        reference (str or object): ``"package.module:name"`` or ``"path/to/file.py:name"``, dots in ``name`` reach
            into a class.
        what (str): what the object is for; the error begins with it.

    Returns:
        object: what the string names.

    Raises:
        ValueError: if the string has no colon, the module cannot be imported, or it has no such name.

    Examples:
        >>> from torchrl_koap.lookup import resolve
        >>> resolve("math:hypotenuse", "goal of task 'toy'")
        Traceback (most recent call last):
        ...
        ValueError: goal of task 'toy': module 'math' has no 'hypotenuse' (asked for as 'math:hypotenuse')
    """
    if not isinstance(reference, str):
        return reference
    module, colon, name = reference.rpartition(":")
    if not (module and colon and name):
        raise ValueError(f"{what}: wanted an import string 'package.module:name', got {reference!r}")
    try:
        found = _run_file(module) if module.endswith(".py") else importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise ValueError(f"{what}: module {module!r} cannot be imported: {error}") from error
    try:
        return functools.reduce(getattr, name.split("."), found)
    except AttributeError:
        raise ValueError(f"{what}: module {module!r} has no {name!r} (asked for as {reference!r})") from None


@functools.cache
def _run_file(path: str) -> ModuleType:
    """The module in a file that no import finds."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, Path(path).expanduser().resolve())
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def exports(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Makes the ``__getattr__`` of a package whose public names are imported when they are first asked for.

    Args:
        package (str): its name.
        modules (mapping): public name to the module that defines it.
    """

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(modules[name]), name)

    return get
