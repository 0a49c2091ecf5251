# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes a page per command from the command line's parser."""

from __future__ import annotations

import contextlib
import io
import re
from typing import Any

from pages import code, heading, table, toctree, write_page

from torchrl_koap.commands.options import parse
from torchrl_koap.commands.subcommands import GROUPS, Subcommand, described


def setup(app: Any) -> dict[str, Any]:
    """Registers the extension with Sphinx."""
    app.connect("builder-inited", lambda app: write_command_pages())
    return {"parallel_read_safe": True}


def write_command_pages() -> None:
    """Writes ``generated/commands``: an index and a page per command."""
    rows, names = [], []
    for group, commands in GROUPS.items():
        for kind in commands:
            name, (about, example) = kind.__name__.lower(), described(kind)
            names.append(name)
            rows.append((group, f":doc:`{name}`", about, f"``{example}``"))
            words = ("--help-all",) if name == "train" else ("--help",)
            write_page(f"commands/{name}", heading(f"koap {name}"), about, code(help_of(name, *words), "text"))
    write_page(
        "commands/index",
        heading("Every command and option"),
        "What ``koap COMMAND --help`` prints. Fields of a configuration in Python "
        "have the same names, with underscores, as in :class:`~torchrl_koap.runs.config.TrainConfig`.",
        table(("group", "command", "what it does", "example"), rows),
        toctree(names, hidden=True),
    )


def help_of(*words: str) -> str:
    """Returns the printed help without colours and rules."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        parse(Subcommand, words)
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).rstrip() for line in out.getvalue().splitlines()]
    return "\n".join(line for line in lines if line.strip("- ") or not line)
