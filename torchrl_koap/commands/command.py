# This source code is licensed under the MIT license found in the LICENSE file.
"""What all commands have in common."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Annotated, TypeVar

import tyro

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
