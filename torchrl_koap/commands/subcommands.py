# This source code is licensed under the MIT license found in the LICENSE file.
"""All commands of ``koap``, named like their classes in lower case; importing them takes seconds."""

from __future__ import annotations

import inspect
from itertools import chain
from typing import Any, Union

from torchrl_koap.commands.data_commands import Convert, Demos, Validate
from torchrl_koap.commands.doctor import Doctor
from torchrl_koap.commands.embed import Embed
from torchrl_koap.commands.run_commands import Bench, Curve, Eval, Export, Inspect, Latency, Suggest, Train

GROUPS = {
    "data": (Demos, Convert, Validate, Embed),
    "train": (Train,),
    "evaluate": (Eval, Inspect, Suggest),
    "deploy": (Export, Latency, Doctor),
    "study": (Curve, Bench),
}
Subcommand: Any = Union[tuple(chain(*GROUPS.values()))]  # noqa: UP007 - of a tuple


def described(command: type) -> tuple[str, str]:
    """Returns summary and example of a command: the first and the last paragraph of its docstring."""
    text = (inspect.getdoc(command) or "").split("\n\nAttributes:")[0].split("\n\n")
    return " ".join(text[0].split()), text[-1].removeprefix("Example: ").strip("`")


def overview() -> str:
    """Returns the text of ``koap --help``: every command with an example, in groups."""
    lines = [
        "usage: koap COMMAND [options]",
        "",
        "Imitation learning with few action labels.",
        "`koap COMMAND --help` explains a command, `koap --version` prints the version.",
    ]
    for group, commands in GROUPS.items():
        lines += ["", f"{group}:"]
        for command in commands:
            about, example = described(command)
            lines += [f"  {command.__name__.lower():<10}{about}", f"{'':<12}$ {example}"]
    return "\n".join(lines)
