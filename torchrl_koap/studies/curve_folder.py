# This source code is licensed under the MIT license found in the LICENSE file.
"""The folder of a curve: what it was asked for, and what a later call may ask of it."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, get_type_hints

from torchrl_koap.runs.config_files import check_type
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.studies.cell_options import OPTION_NAMES

if TYPE_CHECKING:
    from torchrl_koap.studies.label_efficiency import CurveConfig

# what all cells of a folder must have in common; the rest may grow
FIXED = (
    "task",
    "dataset",
    "demonstrations",
    "units",
    "episodes",
    "steps",
    "controller_steps",
    "planner_from",
    "planner_observations",
    "data_share",
    *OPTION_NAMES,
)
GROWS = ("methods", "fractions", "observations", "seeds")


def check_folder(root: RunDirectory, options: CurveConfig) -> None:
    """Refuses a folder that holds something else, or a curve with other settings.

    Args:
        root (RunDirectory): the folder, which may not be there yet.
        options (CurveConfig): what is asked for.

    Raises:
        RunDirectoryError: naming what differs.
    """
    if (root.path / "curve.json").exists():
        earlier, now = read_options(root, type(options)), as_json(options)
        # an option that is younger than the folder was at its default
        earlier = {name: earlier.get(name, getattr(type(options), name)) for name in FIXED}
        changed = [f"{name} ({value})" for name, value in earlier.items() if now[name] != value]
        if changed:
            raise RunDirectoryError(
                f"{root.path} holds a curve with another {', '.join(changed)}; choose another --out"
            )
        return
    if root.path.exists() and not root.path.is_dir():
        raise RunDirectoryError(f"{root.path} is a file; choose another --out")
    # what a curve leaves that was killed before it came to write its options
    own = ("lock", "demonstrations", ".curve.json.")
    if root.path.exists() and not all(path.name.startswith(own) for path in root.path.iterdir()):
        raise RunDirectoryError(f"{root.path} is not empty and no folder of `koap curve`; choose another --out")


def read_options(root: RunDirectory, kind: type) -> dict[str, Any]:
    """What ``curve.json`` holds, its entries of the types that they were written with.

    Args:
        root (RunDirectory): folder of the curve.
        kind (type): the dataclass that it was written from.

    Raises:
        RunDirectoryError: if it is missing or damaged.
    """
    earlier = root.read_json("curve.json")
    for name, hint in get_type_hints(kind).items():
        if name in earlier:
            check_type(earlier[name], hint, f"{root.path / 'curve.json'} is damaged: entry {name!r}")
    return earlier


def as_json(options: CurveConfig) -> dict[str, Any]:
    """The options as ``curve.json`` holds them."""
    planner = None if options.planner_from is None else os.path.abspath(options.planner_from)
    return asdict(options) | {"out": str(options.out), "dataset": dataset_of(options), "planner_from": planner}


def write_options(root: RunDirectory, options: CurveConfig) -> None:
    """Keeps what was asked for, earlier methods, fractions and seeds included.

    Args:
        root (RunDirectory): the folder.
        options (CurveConfig): what is asked for.
    """
    content = as_json(options)
    if (root.path / "curve.json").exists():
        earlier = read_options(root, type(options))
        for name in ("methods", "fractions", "observations"):
            content[name] = ",".join(dict.fromkeys([*str(earlier[name]).split(","), *content[name].split(",")]))
        content["seeds"] = max(earlier["seeds"], content["seeds"])
    root.write_json("curve.json", content)


def with_earlier_plugins(options: CurveConfig) -> CurveConfig:
    """The options with the plugins of earlier calls, without which methods of theirs would be unknown."""
    root = RunDirectory(options.out)
    earlier = read_options(root, type(options)).get("plugins") or () if (root.path / "curve.json").exists() else ()
    return replace(options, plugins=tuple(dict.fromkeys([*earlier, *options.plugins])))


def dataset_of(options: CurveConfig) -> str:
    """The data set by its whole path: a cell may run in another working directory."""
    return options.dataset if options.dataset == "scripted" else os.path.abspath(options.dataset)
