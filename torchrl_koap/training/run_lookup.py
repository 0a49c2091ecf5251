# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs by path or by name: the trained policies that the repository holds."""

from __future__ import annotations

from pathlib import Path

from torchrl_koap.lookup import lookup
from torchrl_koap.training.run_directory import RunDirectoryError

PREFIX = "pretrained:"


def pretrained_folders() -> dict[str, Path]:
    """Names and folders of the trained policies: those of the checkout, or below the present folder.

    Examples:
        >>> from torchrl_koap.training.run_lookup import pretrained_folders
        >>> all((folder / "config.json").exists() for folder in pretrained_folders().values())
        True
    """
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
