# This source code is licensed under the MIT license found in the LICENSE file.
"""The command line ``koap``: sub-commands are dataclasses, their fields are the options, calling one does the work."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from typing import Annotated, Any

import tyro

from torchrl_koap import __version__
from torchrl_koap.commands.bench import Bench
from torchrl_koap.commands.convert import Convert
from torchrl_koap.commands.curve import Curve
from torchrl_koap.commands.demos import Demos
from torchrl_koap.commands.doctor import Doctor, Validate
from torchrl_koap.commands.eval import Eval
from torchrl_koap.commands.export import Export
from torchrl_koap.commands.inspect import Inspect
from torchrl_koap.commands.latency import Latency
from torchrl_koap.commands.suggest import Suggest
from torchrl_koap.commands.train import Train
from torchrl_koap.training.progress import without_progress_bars

# errors that speak for themselves; anything else is a fault of ours and keeps its traceback
EXPECTED = (ValueError, RuntimeError, KeyError, OSError)
HINT = "KOAP_TRACEBACK=1 shows where"
DESCRIPTION = "Imitation learning with few action labels. `koap --version` prints the version."

Subcommand = (
    Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Demos, tyro.conf.subcommand("demos")]
    | Annotated[Train, tyro.conf.subcommand("train")]
    | Annotated[Eval, tyro.conf.subcommand("eval")]
    | Annotated[Curve, tyro.conf.subcommand("curve")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
    | Annotated[Inspect, tyro.conf.subcommand("inspect")]
    | Annotated[Suggest, tyro.conf.subcommand("suggest")]
    | Annotated[Export, tyro.conf.subcommand("export")]
    | Annotated[Latency, tyro.conf.subcommand("latency")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Validate, tyro.conf.subcommand("validate")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a sub-command; returns the exit status.

    It is 1 for a job that could not be done, or not all of it, and 130 for one that was interrupted, each with one
    line that says why. A wrong call leaves with 2. ``KOAP_TRACEBACK=1`` shows where an error is from.

    Args:
        arguments (sequence of str, optional): the words of the command line. Default: those of the process.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        print(f"koap {__version__}")
        return 0
    command = tyro.cli(Subcommand, args=arguments, prog="koap", description=DESCRIPTION)
    try:
        with without_progress_bars() if command.quiet else nullcontext():
            result = command()
    except EXPECTED as error:
        if os.environ.get("KOAP_TRACEBACK"):
            raise
        print(f"koap: {one_line(error)} ({HINT})", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print(
            "koap: interrupted; `koap train --resume` goes on from its last checkpoint, `koap curve` when called again",
            file=sys.stderr,
        )
        return 130
    if not command.quiet:
        show(result)
    return 1 if isinstance(result, Mapping) and result.get("failed") else 0


def one_line(error: Exception) -> str:
    """The message of an error, the problems it lists one after the other."""
    message = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    return "; ".join(line.strip().removeprefix("- ") for line in message.splitlines()) or type(error).__name__


def show(result: Any) -> None:
    """Prints a result: a table of names and values, without the rows of single episodes."""
    if not isinstance(result, Mapping):
        print(result)
        return
    lines = [line for key, value in result.items() if key != "episode" for line in _lines(key, value)]
    width = min(max(len(name) for name, _ in lines), 45)
    for name, text in lines:
        print(f"{name:<{width}}  {text}")


def _lines(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """A line per value; a mapping of plain values is one line, a nested one a line for each of its entries."""
    if isinstance(value, Mapping) and any(isinstance(entry, Mapping) for entry in value.values()):
        for key, entry in value.items():
            yield from _lines(f"{name} {key}", entry)
    elif isinstance(value, Mapping):
        yield name, json.dumps({key: _short(entry) for key, entry in value.items()})
    else:
        yield name, _short(value)


def _short(value: Any) -> Any:
    if isinstance(value, list):
        return [_short(entry) for entry in value]
    return float(f"{value:.4g}") if isinstance(value, float) else value


if __name__ == "__main__":
    sys.exit(main())
