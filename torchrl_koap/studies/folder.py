# This source code is licensed under the MIT license found in the LICENSE file.
"""The folder of a study: what earlier calls asked for in it, and whether this one may go on there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchrl_koap.runs.config_files import from_json, to_json
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies.study import Study, union

FILE = "study.json"
# what a later call may add to; all else must be as it was
_LISTS = ("tasks", "datasets", "planners", "methods", "labels", "levels", "demonstrations")
_MAY_CHANGE = (*_LISTS, "seeds", "first_seed_only", "out", "run.plugins")


def read_study(folder: Path) -> Study | None:
    """Reads what an earlier call in a folder asked for, None if there was none.

    Raises:
        RunDirectoryError: if ``study.json`` is damaged.
    """
    run = RunDirectory(folder)
    if not (run.path / FILE).exists():
        return None
    return from_json(Study, run.read_json(FILE), run.path / FILE)


def together(study: Study) -> Study:
    """A complete study and what earlier calls in its folder asked for besides."""
    earlier = read_study(study.out)
    if earlier is None:
        return study
    lists: dict[str, Any] = {name: union(vars(earlier)[name], vars(study)[name]) for name in _LISTS}
    first_seed_only = tuple(level for level in study.first_seed_only if level in earlier.first_seed_only)
    return replace(study, **lists, seeds=max(study.seeds, earlier.seeds), first_seed_only=first_seed_only)


def check_folder(study: Study) -> None:
    """Refuses a folder that holds something else, or a study with other settings.

    Raises:
        RunDirectoryError: naming what differs.
    """
    path, earlier = study.out, read_study(study.out)
    if earlier is None:
        if path.exists() and not path.is_dir():
            raise RunDirectoryError(f"{path} is a file; choose another --out")
        # what a study leaves that was killed before it came to write its options
        own = ("lock", "demonstrations", f".{FILE}.")
        if path.exists() and not all(entry.name.startswith(own) for entry in path.iterdir()):
            raise RunDirectoryError(f"{path} is not empty and no folder of `koap curve`; choose another --out")
        return
    was, now = (flat_options(to_json(options)) for options in (earlier, study))
    changed = [name for name in now if name not in _MAY_CHANGE and was[name] != now[name]]
    for name, before, after in (
        ("datasets", earlier.given_dataset, study.given_dataset),
        ("planners", earlier.given_planner, study.given_planner),
    ):
        if any(before(task) != after(task) for task in {*earlier.tasks} & {*study.tasks}):
            changed.append(name)
    if changed:
        values = [", ".join(map(str, was[name])) if isinstance(was[name], list) else was[name] for name in changed]
        told = ", ".join(f"{name} ({value})" for name, value in zip(changed, values, strict=True))
        raise RunDirectoryError(f"{path} holds a study with another {told}; choose another --out")


def flat_options(options: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Options of all sections together, each by its name with the section."""
    flat: dict[str, Any] = {}
    for name, value in options.items():
        inside = isinstance(value, Mapping)
        flat |= flat_options(value, f"{prefix}{name}.") if inside else {prefix + name: value}
    return flat
