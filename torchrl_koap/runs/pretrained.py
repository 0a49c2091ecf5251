# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs by path or by name, the trained policies of the repository, and runs that are evaluated in another folder."""

from __future__ import annotations

import shutil
from pathlib import Path

from torchrl_koap.lookup import lookup
from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError

PREFIX = "pretrained:"
# what a run is made of; evaluations, reports and checkpoints are made from it
FILES = ("config.json", "summary.json", "metrics.csv", "planner.safetensors", "controller.safetensors")


def pretrained_folders() -> dict[str, Path]:
    """Names and folders of the trained policies: those of the checkout, or below the present folder."""
    roots = [Path("pretrained"), Path(__file__).resolve().parents[2] / "pretrained"]
    folders = [folder for root in roots if root.is_dir() for folder in sorted(root.iterdir())]
    return {folder.name: folder for folder in reversed(folders) if (folder / "config.json").exists()}


def find_run(name: str | Path) -> Path:
    """The folder of a run: a path as it is, ``pretrained:NAME`` looked up.

    Raises:
        ValueError: if there is no trained policy of that name; the message suggests the nearest.
        RunDirectoryError: if there are none at all: the library was installed without its repository.
    """
    name = str(name)
    if not name.startswith(PREFIX):
        return Path(name)
    folders = pretrained_folders()
    if not folders:
        raise RunDirectoryError(
            f"{name!r} was asked for, but there is no folder 'pretrained' here or beside the package: it is part of the"
            " repository, not of an installed wheel"
        )
    return lookup(folders, name.removeprefix(PREFIX), "pretrained policy")


def copy_run(source: str | Path, target: str | Path) -> Path:
    """Copies what a run is made of, and nothing that an evaluation wrote, to a folder that is new or holds that run.

    Raises:
        RunDirectoryError: if the source is no run, or the target holds another one.
    """
    source, target = Path(source), Path(target)
    config = RunDirectory(source).read_json("config.json")
    if (target / "config.json").exists() and RunDirectory(target).read_json("config.json") != config:
        raise RunDirectoryError(f"{target} holds another run than {source}; choose another --out")
    target.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        if (source / name).exists():
            shutil.copyfile(source / name, target / name)
    return target


def writable_folder(run: str | Path, out: str | Path | None = None) -> Path:
    """The folder that results about a run are written to: its own, or ``out``, to which what it is made of is copied.

    Raises:
        ValueError: if a pretrained run comes without another folder.
        RunDirectoryError: as :func:`copy_run` and :func:`find_run`.
    """
    source = find_run(run)
    if out is not None:
        return copy_run(source, out)
    if str(run).startswith(PREFIX):
        raise ValueError(f"nothing is written into {run}: name a folder of your own with --out")
    return source
