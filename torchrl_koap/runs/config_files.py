# This source code is licensed under the MIT license found in the LICENSE file.
"""Options as JSON: read into the dataclasses that they were written from, and refused with file and name otherwise."""

from __future__ import annotations

import difflib
import functools
import importlib.metadata
import json
import math
import os
import platform
import types
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError

Config = TypeVar("Config")
FACTS = ("task_definition", "data", "held_out_episodes", "versions", "command")  # beside the options in config.json
_PACKAGES = ("torchrl_koap", "torch", "torchrl", "tensordict", "mujoco")
_LARGEST = 2**63 - 1


def read_config(run: RunDirectory) -> TrainConfig:
    """Reads the options of a run.

    Raises:
        RunDirectoryError: if ``config.json`` is not there or damaged; the message names file and entry.
    """
    content = run.read_json("config.json")
    for field in fields(TrainConfig):
        if field.name not in content:
            raise RunDirectoryError(f"{run.path / 'config.json'} has no entry {field.name!r}")
    return from_json(TrainConfig, {k: v for k, v in content.items() if k not in FACTS}, run.path / "config.json")


def to_json(config: Any) -> dict[str, Any]:
    """Returns options as ``json`` reads them, section by section; infinity, which JSON does not know, as ``"inf"``."""
    text = json.dumps(asdict(config), default=os.fspath)
    return json.loads(text, parse_constant=lambda word: word.replace("Infinity", "inf"))


def from_json(kind: type[Config], content: Any, path: str | Path) -> Config:
    """Makes a dataclass, and those that are its sections, of a JSON object; what is left out keeps its default.

    Raises:
        RunDirectoryError: naming the file and an option that is unknown, in another section, of another type or out of
            range.
    """
    return _read(kind, content, f"{path}", "", tuple(_names(kind)))


def _read(kind: Any, content: Any, path: str, prefix: str, known: tuple[str, ...]) -> Any:
    if not isinstance(content, Mapping):
        raise RunDirectoryError(f"{path}: {prefix.rstrip('.') or 'the file'} must be an object, got {_short(content)}")
    kinds, values = get_type_hints(kind), {}
    for name, value in content.items():
        if name not in kinds:
            raise RunDirectoryError(f"{path}: {_unknown(prefix + str(name), known)}")
        if is_dataclass(kinds[name]):
            values[name] = _read(kinds[name], value, path, f"{prefix}{name}.", known)
        else:
            if value == "inf" and _fits(math.inf, kinds[name]):
                value = math.inf
            if not _fits(value, kinds[name]):
                wanted = f"{prefix}{name} must be {_words(kinds[name])}"
                raise RunDirectoryError(f"{path}: {wanted}, got {_short(value)}")
            values[name] = tuple(value) if isinstance(value, list) else value
    try:
        return kind(**values)
    except (TypeError, ValueError) as error:
        raise RunDirectoryError(f"{path}: {error}") from error


def _names(kind: Any, prefix: str = "") -> Iterator[str]:
    """Every option with its section, ``"planner.steps"``."""
    for name, inner in get_type_hints(kind).items():
        if is_dataclass(inner):
            yield from _names(inner, f"{prefix}{name}.")
        else:
            yield prefix + name


def _unknown(name: str, known: tuple[str, ...]) -> str:
    last = name.rpartition(".")[2]
    elsewhere = [other for other in known if other.rpartition(".")[2] == last]
    if elsewhere:
        sections = [f"section {other.rpartition('.')[0]}" if "." in other else "no section" for other in elsewhere]
        return f"unknown option {name}: {last} is in {' or '.join(sections)}"
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    return f"unknown option {name}" + (f": did you mean {near[0]}?" if near else "")


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: version_of(name) for name in _PACKAGES}


@functools.cache
def version_of(package: str) -> str:
    """Returns the version of an installed package, or "MISSING", as of a checkout on ``PYTHONPATH``."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "MISSING"


def changed_options(one: Any, other: Any, prefix: str = "") -> list[str]:
    """Returns the names of the options, with their sections, in which two configurations of one kind differ."""
    changed = []
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if is_dataclass(a):
            changed += changed_options(a, b, f"{prefix}{field.name}.")
        elif a != b:
            changed.append(prefix + field.name)
    return changed


def fill_in(asked: Config, known: Any) -> Config:
    """Puts known options in place of those that are at their defaults, likewise in every section.

    They are a dataclass, or by name, sections in mappings of their own; some may be missing.
    """
    known = known if isinstance(known, Mapping) else vars(known)
    found = {}
    for option in fields(asked):  # type: ignore[arg-type]
        value = getattr(asked, option.name)
        if option.name in known and is_dataclass(value):
            found[option.name] = fill_in(value, known[option.name])
        elif option.name in known and value == option.default:
            found[option.name] = known[option.name]
    return replace(asked, **found)  # type: ignore[type-var]


def _fits(value: Any, kind: Any) -> bool:
    if get_origin(kind) in (Union, types.UnionType):
        return any(_fits(value, part) for part in get_args(kind))
    if kind is type(None):
        return value is None
    if get_origin(kind) is tuple:
        return isinstance(value, (list, tuple)) and all(_fits(entry, get_args(kind)[0]) for entry in value)
    if kind is Path:
        return isinstance(value, str) and "\0" not in value
    if kind is int:
        return type(value) is int and abs(value) <= _LARGEST
    if kind is float:
        return isinstance(value, float) or (type(value) is int and abs(value) <= _LARGEST)
    return isinstance(value, kind)


def _words(kind: Any) -> str:
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(_words(part) for part in get_args(kind))
    if get_origin(kind) is tuple:
        return f"a list of {_words(get_args(kind)[0])}"
    names = {type(None): "null", Path: "a path", bool: "true or false", str: "text", float: "a number"}
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
