# This source code is licensed under the MIT license found in the LICENSE file.
"""What all commands have in common: their base class, what no option can mean, and short names of `koap train`'s."""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from torchrl_koap.files import read_bytes
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import FACTS, from_json
from torchrl_koap.runs.run_directory import RunDirectoryError

LARGEST = 2**53  # beyond it a number is not even counted exactly
Config = TypeVar("Config")
# the fields of a configuration are options of the command itself: `--steps`, not `--config.steps`
Options = Annotated[Config, tyro.conf.arg(name="")]
# short names of the options that most calls need: option, what follows, help
SHORT: dict[str, tuple[str, str, str]] = {
    "--dataset": ("--dataset", "DIR", "folder with demonstrations, such as `koap demos --out DIR` records"),
    "--out": ("--out", "DIR", "run directory to write"),
    "--task": ("--task", "NAME", "name of the task (default: that of the data set)"),
    "--method": ("--method", "NAME", "koap, linear, dd, dp, mpc, ... (default: the task's)"),
    "--labels": ("--labels", "NUMBER", "labels that may be seen: 5 trajectories, or 0.02 of them (default: all)"),
    "--preset": ("--controller.preset", "NAME", "variant of KOAP: default, semi_supervised or paper"),
    "--steps": ("--planner.steps", "N", "updates of the planner (default: the task's)"),
    "--strategy": ("--execution.strategy", "NAME", "how plans become actions: feedback or open_loop"),
    "--seed": ("--run.seed", "N", "of label choice, initialisation and batches"),
    "--device": ("--run.device", "NAME", "cpu or cuda"),
    "--threads": ("--run.threads", "N", "torch threads"),
    "--resume": ("--run.resume", "", "go on with an interrupted run"),
    "--logger": ("--run.logger", "NAME", "csv, wandb or tensorboard"),
    "--plugin": ("--run.plugin", "NAME", "module that registers tasks or methods"),
    "--config": ("--config", "FILE", "JSON file of options in the same sections; options of the call win"),
}


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

    Raises:
        ValueError: for numbers that are NaN, infinite or beyond 2^53, and an ``out`` that lies below a file.
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


def expand(words: Sequence[str]) -> list[str]:
    """Replaces short options by those that they stand for, and ``--config FILE`` by the options in the file.

    Raises:
        RunDirectoryError: if the file is not there, or holds other things than options.
        ValueError: if ``--labels`` is no number.

    Examples:
        >>> from torchrl_koap.commands.options import expand
        >>> expand(["--steps", "20", "--labels", "0.02", "--seed=3"])
        ['--planner.steps', '20', '--labels.fraction', '0.02', '--run.seed=3']
    """
    found: list[str] = []
    from_file: list[str] = []
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        name = name.replace("_", "-")
        if name == "--help-all":
            found.append("--help")
        elif name == "--no-resume":
            found.append("--run.no-resume")
        elif name in ("--labels", "--config"):
            value = value if equals else next(rest, "")
            if name == "--config":
                from_file += _words_of(Path(value), {"labels"} if "--labels" in words else set())
            else:
                found += [f"--labels.{_kind_of(value)}", value]
        elif name in SHORT:
            found.append(SHORT[name][0] + equals + value)
        else:
            found.append(word)
    return [*from_file, *found]


def _kind_of(labels: str) -> str:
    for kind, number in (("count", int), ("fraction", float)):
        with contextlib.suppress(ValueError):
            number(labels)
            return kind
    raise ValueError(f"--labels must be a number of trajectories such as 5, or a share such as 0.02, got {labels!r}")


def _words_of(path: Path, without: set[str]) -> list[str]:
    """The options in a file as words of a command line."""
    try:
        content = json.loads(read_bytes(path).decode())
    except (ValueError, OSError) as error:
        raise RunDirectoryError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict):
        raise RunDirectoryError(f"{path} is no file of options: wanted an object, got {type(content).__name__}")
    options = {name: value for name, value in content.items() if name not in FACTS and name not in without}
    from_json(TrainConfig, {"out": ""} | options, path)
    return list(_flat(options))


def _flat(options: Mapping[str, Any], prefix: str = "--") -> Iterator[str]:
    for name, value in options.items():
        name = name.replace("_", "-")
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, bool):
            yield f"{prefix}{name}" if value else f"{prefix}no-{name}"
        elif isinstance(value, list):
            if name == "plugins":
                yield from (word for plugin in value for word in (f"{prefix}plugin", plugin))
            elif value:
                yield from (f"{prefix}{name}", *map(str, value))
        elif value is not None:
            yield from (f"{prefix}{name}", str(value))


def show_help() -> None:
    """Prints the options that most calls need, and leaves."""
    page = argparse.ArgumentParser(
        prog="koap train",
        usage="koap train --dataset DIR --out DIR [options]",
        description="Train planner and controller on demonstrations of which few have action labels. `koap train"
        " --help-all` shows every option, by section.",
    )
    for name, (_, kind, about) in SHORT.items():
        options: dict[str, Any] = {"metavar": kind} if kind else {"action": "store_true"}
        page.add_argument(name, help=about, **options)
    page.print_help()
    sys.exit(0)
