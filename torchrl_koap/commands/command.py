# This source code is licensed under the MIT license found in the LICENSE file.
"""What all commands have in common: their base class, and what no option can mean whatever it is for."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

LARGEST = 2**53  # beyond it a number is not even counted exactly
Config = TypeVar("Config")
# the fields of a configuration are options of the command itself: `--steps`, not `--config.steps`
Options = Annotated[Config, tyro.conf.arg(name="")]


@dataclass(kw_only=True)
class Command:
    """A command of ``koap``: its fields are options, calling it does the work and returns what is printed.

    Attributes:
        quiet: no progress bars, and no table at the end.
    """

    quiet: bool = False


def as_typed() -> str:
    """The command line of this process, for ``config.json``."""
    return "koap " + " ".join(sys.argv[1:])


def check_options(options: Any) -> None:
    """Checks the options of a command, those of its configurations included.

    Args:
        options (dataclass): the command.

    Raises:
        ValueError: for numbers that are NaN, infinite or beyond 2^53, and an ``out`` that lies below a file.

    Examples:
        >>> from dataclasses import dataclass
        >>> from torchrl_koap.commands.command import check_options
        >>> @dataclass
        ... class Options:
        ...     label_fraction: float
        >>> check_options(Options(0.5))
        >>> try:
        ...     check_options(Options(float("nan")))
        ... except ValueError as error:
        ...     print(error)
        --label-fraction must be a finite number, got nan
    """
    for field in fields(options):
        value, option = getattr(options, field.name), f"--{field.name.replace('_', '-')}"
        if is_dataclass(value):
            check_options(value)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{option} must be a finite number, got {number}")
            if isinstance(number, (int, float)) and abs(number) > LARGEST:
                raise ValueError(f"{option} must be at most {LARGEST:,}, got {number:,}")
        if field.name == "out" and value is not None:
            _check_folder(Path(value), option)


def _check_folder(path: Path, option: str) -> None:
    there = next((above for above in (path, *path.parents) if above.exists()), None)
    if there is not None and not there.is_dir():
        raise ValueError(f"{option} {path} cannot be made: {there} is no folder")
