# This source code is licensed under the MIT license found in the LICENSE file.
"""A page per command from the parser of the command line itself."""

from __future__ import annotations

import contextlib
import inspect
import io
import re
from typing import Any, get_args

import tyro
from pages import code, heading, table, toctree, write_page

from torchrl_koap.commands.subcommands import Subcommand


def setup(app: Any) -> dict[str, Any]:
    """Called by Sphinx."""
    app.connect("builder-inited", lambda app: write_command_pages())
    return {"parallel_read_safe": True}


def write_command_pages() -> None:
    """Writes ``generated/commands``: an index and a page per command."""
    commands = {kind.__name__.lower(): kind for kind in get_args(Subcommand)}
    for name, kind in commands.items():
        write_page(
            f"commands/{name}",
            heading(f"koap {name}"),
            summary(kind),
            code(help_of(name), "text"),
        )
    write_page(
        "commands/index",
        heading("Every command and option"),
        "What ``koap COMMAND --help`` prints, but for defaults that are ``None``. Fields of a configuration in Python "
        "have the same names, with underscores, as in :class:`~torchrl_koap.runs.config.TrainConfig`.",
        table(("command", "what it does"), [(f":doc:`{name}`", summary(kind)) for name, kind in commands.items()]),
        toctree(commands, hidden=True),
    )


def summary(kind: type) -> str:
    """First paragraph of its docstring."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def help_of(name: str) -> str:
    """What ``--help`` prints, without colours and frames."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        tyro.cli(Subcommand, args=[name, "--help"], prog="koap")
    text = re.sub(r"\x1b\[[0-9;]*m", "", out.getvalue())
    lines = [line.strip("│").rstrip() for line in text.splitlines()]
    lines = [re.sub(r"^[╭╰]─+\s?|\s?─*[╮╯]$", "", line) for line in lines]
    text = "\n".join(line for line in lines if line.strip("─ ") or not line)
    text = re.sub(r"\{None\}\|(?:\{(\[.*?\])\}|(\S+))", r"\1\2", text)
    # what stood beside a shorter name goes back to its column
    text = re.sub(r"^(  --\S+ \S+) +(?=\S)", lambda found: f"{found[1]:<27}", text, flags=re.MULTILINE)
    return re.sub(r"\s*\(default:\s+None\)", "", text)
