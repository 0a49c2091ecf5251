# This source code is licensed under the MIT license found in the LICENSE file.
"""Looks names up in tables, suggesting the most similar one, and resolves import strings."""

from __future__ import annotations

import difflib
import functools
import importlib
import importlib.metadata
import importlib.util
import re
import sys
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any


def lookup(table: Mapping[str, Any] | Collection[str], name: object, what: str) -> Any:
    """Returns the entry ``name`` of a table, or ``name`` itself if the table is a plain collection of names.

    Raises:
        ValueError: if the name is unknown or not a string. The message says ``what`` the name stands for, and suggests
            the most similar name or lists all.

    Examples:
        >>> from torchrl_koap.lookup import lookup
        >>> lookup({"dense": 1, "diagonal": 2}, "diagnoal", "structure")
        Traceback (most recent call last):
        ...
        ValueError: unknown structure 'diagnoal'; did you mean 'diagonal'?
    """
    if isinstance(name, str) and name in table:
        return table[name] if isinstance(table, Mapping) else name
    raise ValueError(_unknown(table, name, what))


def check_free(table: Collection[str], name: str, what: str, where: str) -> None:
    """Raises a ValueError if a table, which is called ``where``, has the name already; it says how to free the name."""
    if name in table:
        cure = f"choose another name, or first `del {where}[{name!r}]`"
        raise ValueError(f"another {what} named {name!r} is registered already; {cure}")


def unknown(asked: Iterable[str], known: Collection[str], what: str) -> list[str]:
    """Returns the message of :func:`lookup` for every unknown name."""
    return [_unknown(known, name, what) for name in asked if name not in known]


def _unknown(known: Collection[str], name: object, what: str) -> str:
    near = nearest(known, name) if isinstance(name, str) else None
    hint = f"known: {', '.join(known)}" if near is None else f"did you mean {near!r}?"
    if parts := [each for each in known if re.fullmatch(rf"{re.escape(str(name))}_\d+", each)]:
        hint = f"did you mean {' '.join(parts)}?"
    return f"unknown {what} {name!r}; {hint}"


def nearest(known: Iterable[str], name: str) -> str | None:
    """Returns the known name that is most similar to ``name``; None if none is similar."""
    lowered = {each.lower(): each for each in known}
    return next((lowered[near] for near in difflib.get_close_matches(name.lower(), lowered, n=1, cutoff=0.5)), None)


def resolve(reference: Any, what: str) -> Any:
    """Imports the object that an import string names; returns anything but a string unchanged.

    Strings are ``"package.module:name"`` or ``"path/to/file.py:name"``; ``name`` may have dots, as in ``Class.method``.

    Raises:
        ValueError: if the string has no colon, the module cannot be imported, or it has no such name; the message
            begins with ``what`` the object is for.
    """
    if not isinstance(reference, str):
        return reference
    module, colon, name = reference.rpartition(":")
    if not (module and colon and name):
        raise ValueError(f"{what}: wanted an import string 'package.module:name', got {reference!r}")
    try:
        found = import_code(module)
    except (ImportError, OSError) as error:
        raise ValueError(f"{what}: module {module!r} cannot be imported: {error}") from error
    try:
        return functools.reduce(getattr, name.split("."), found)
    except AttributeError:
        raise ValueError(f"{what}: module {module!r} has no {name!r} (asked for as {reference!r})") from None


def import_code(module: str) -> ModuleType:
    """Imports a module by its dotted name, or runs a file ``*.py`` by its path, once per process."""
    return _run_file(absolute(module)) if module.endswith(".py") else importlib.import_module(module)


def absolute(reference: str) -> str:
    """Makes the path of a file ``*.py``, or of an import string ``"file.py:name"``, absolute."""
    is_file = reference.partition(":")[0].endswith(".py")
    return str(Path(reference).expanduser().resolve()) if is_file else reference


def import_extra(module: str, extra: str, needs: str) -> Any:
    """Imports an optional package.

    Raises:
        RuntimeError: if it is not installed; the message begins with ``needs``, and names the extra to install.
    """
    if importlib.util.find_spec(module) is None:
        raise RuntimeError(f"{needs} an extra: pip install 'torchrl_koap[{extra}]'")
    return importlib.import_module(module)


@functools.cache
def _run_file(path: str) -> ModuleType:
    name = path.replace(".", "_")  # Python would import what precedes a dot as a package
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is no Python file")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)  # where dataclasses and pickle look it up
    spec.loader.exec_module(module)
    return module


def entry_points_of(group: str) -> list[Any]:
    """Loads the objects that installed packages declare in an entry-point group, such as ``"torchrl_koap.methods"``.

    Raises:
        ValueError: if one cannot be imported; the message names entry and group.
    """
    found = []
    for entry in importlib.metadata.entry_points(group=group):
        try:
            found.append(entry.load())
        except Exception as error:
            said = f"entry point {entry.name!r} = {entry.value!r} of {group!r} failed when it was imported"
            raise ValueError(f"{said}: {type(error).__name__}: {error}") from error
    return found


def exports(package: str, offers: Mapping[str, Collection[str]]) -> tuple[Callable[[str], Any], list[str]]:
    """Makes ``__getattr__`` and ``__all__`` of a package that imports public names and modules at first access.

    Args:
        package (str): name of the package.
        offers (mapping): maps modules, relative to the package, to the public names that they define.
    """
    modules = {name: f"{package}.{module}" for module, names in offers.items() for name in names}

    def get(name: str) -> Any:
        if name in modules:
            return getattr(importlib.import_module(modules[name]), name)
        if importlib.util.find_spec(f"{package}.{name}") is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return importlib.import_module(f"{package}.{name}")

    return get, list(modules)
