# This source code is licensed under the MIT license found in the LICENSE file.
"""Damage that can be done to any file."""

import os
from collections.abc import Callable
from pathlib import Path


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[-9] ^= 4
    path.write_bytes(content)


def grow(path: Path) -> None:
    """More than any memory holds; the disk is not asked for it."""
    with path.open("r+b") as file:
        file.truncate(40 << 30)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def zeros(path: Path) -> None:
    path.unlink()
    path.symlink_to("/dev/zero")


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


# damage to any file
DAMAGE: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda path: path.write_bytes(b""),
    "cut off": lambda path: os.truncate(path, path.stat().st_size // 2),
    "cut by a byte": lambda path: os.truncate(path, path.stat().st_size - 3),
    "of noise": lambda path: path.write_bytes(bytes(range(256)) * 8),
    "of another kind": lambda path: path.write_text("just words\n" * 30),
    "a folder": folder,
    "a pipe": pipe,
    "without end": zeros,
    "of 40 GB": grow,
}
