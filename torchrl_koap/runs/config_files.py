# This source code is licensed under the MIT license found in the LICENSE file.
"""Options as JSON: read back into their dataclasses; errors name the file and the option."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import json
import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from torchrl_koap.files import dataclass_from_json
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError

Config = TypeVar("Config")
# entries of config.json that are not options
FACTS = ("task_definition", "data", "held_out_episodes", "held_out_states", "planner_only", "versions", "command")
_PACKAGES = ("torchrl_koap", "torch", "torchrl", "tensordict", "mujoco")


def read_config(run: RunDirectory) -> TrainConfig:
    """Reads the options of a run; a RunDirectoryError names a file or entry that is missing or damaged."""
    content = run.read_json("config.json")
    for field in fields(TrainConfig):
        if field.name not in content:
            raise RunDirectoryError(f"{run.path / 'config.json'} has no entry {field.name!r}")
    return from_json(TrainConfig, {k: v for k, v in content.items() if k not in FACTS}, run.path / "config.json")


def to_json(config: Any) -> dict[str, Any]:
    """Returns options as JSON objects, section by section; infinity, which JSON lacks, becomes ``"inf"``."""
    text = json.dumps(asdict(config), default=os.fspath)
    return json.loads(text, parse_constant=lambda word: word.replace("Infinity", "inf"))


def from_json(kind: type[Config], content: Any, path: str | Path) -> Config:
    """Makes a dataclass and its sections from a JSON object; missing options keep their defaults.

    A RunDirectoryError names the file and an option that is unknown, of another type or out of range.
    """
    try:
        return dataclass_from_json(kind, content)
    except (TypeError, ValueError) as error:
        raise RunDirectoryError(f"{path}: {error}") from error


def versions() -> dict[str, str]:
    """Returns the versions of Python and of the packages that results depend on, and a checksum of this package."""
    known = {"python": platform.python_version(), "code": code_checksum()}
    return known | {name: version_of(name) for name in _PACKAGES}


@functools.cache
def code_checksum(root: Path = Path(__file__).parents[1]) -> str:
    """Computes a checksum of this package's modules, which change in a checkout while the version stays the same."""
    digest = hashlib.sha256()
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:12]


@functools.cache
def version_of(package: str) -> str:
    """Returns the version of a package, or "MISSING" if it is not installed, as a checkout on ``PYTHONPATH``."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "MISSING"


def changed_options(one: Any, other: Any, prefix: str = "") -> list[str]:
    """Returns the names, with sections, of the options in which two configurations of one class differ."""
    changed = []
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        if is_dataclass(a):
            changed += changed_options(a, b, f"{prefix}{field.name}.")
        elif a != b:
            changed.append(prefix + field.name)
    return changed


def fill_in(asked: Config, known: Any) -> Config:
    """Replaces options that have their default values by known ones, also in every section.

    ``known`` is a dataclass, or a mapping by name with a mapping for each section; options may be missing.
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
