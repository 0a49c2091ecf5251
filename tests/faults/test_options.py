# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests every option of every command with values that its type does not allow."""

import re
import types
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest
from fault_ledger import EMBED, Fault, check, meet, table
from tiny_runs import TINY

from torchrl_koap.commands.subcommands import Subcommand
from torchrl_koap.studies.study import DECIDED

HUGE = str(10**30)
# calls that would do
BASE = {
    "convert": ("{arrays}", "--out", "{out}", "--control-hz", "30"),
    "demos": ("--out", "{out}", "--episodes", "1", "--threads", "1"),
    "train": ("--out", "{out}", "--dataset", "{data}", *TINY),
    "eval": ("{run}", "--episodes", "1", "--threads", "1", "--no-report"),
    "curve": (
        *("--out", "{out}", "--datasets", "{data}", "--methods", "linear", "--labels", "0.5", "--seeds", "1"),
        *("--planner.steps", "2", "--evaluation.episodes", "1", "--workers", "1"),
    ),
    "bench": ("--out", "{out}", "--table", "1", "--tasks", "avoiding", "--seeds", "1", "--workers", "1"),
    "inspect": ("{run}", "--episodes", "1", "--threads", "1"),
    "suggest": ("{run}",),
    "export": ("{run}",),
    "latency": ("{run}", "--steps", "2"),
    "doctor": (),
    "validate": ("{data}",),
    "embed": EMBED,
}
WRONG: dict[Any, tuple[str, ...]] = {
    int: ("many", "1.5", "-1", "0", HUGE),
    float: ("many", "-1", "nan", "inf"),
    bool: ("maybe",),
    str: ("n0nsense", ""),
    Path: ("", "/dev/null/below"),
}
# values that are right after all: names of one's own, 0 where it means "none of it", limits that hold nothing
RIGHT = {
    "convert": ("--name n0nsense",),
    "demos": ("--seed 0",),
    "eval": ("--seed 0", "--limits inf"),
    "inspect": ("--seed 0", "--limits inf"),
    "train": (
        *("--run.seed 0", "--controller.steps 0", "--planner.held-out 0", "--planner.octaves 0"),
        *("--execution.blend 0", "--execution.lead 0", "--execution.limits inf"),
    ),
}
RIGHT["curve"] = (*(call for call in RIGHT["train"] if call != "--run.seed 0"), "--evaluation.seed 0")
# of its methods dp follows no plan, and koap_paper has no closed form
RIGHT["bench"] = tuple(call for call in RIGHT["curve"] if call not in ("--execution.blend 0", "--controller.steps 0"))
EMPTY = ("--action-units", "--state-units")  # of a number without a unit
# where the message has another word for the option
SAYS = {
    "--labels.unit": "unit",
    "--label-unit": "unit",
    "--planner.source": "/dev/null/below|source",
    "--action-kind": "kind of action|action-kind",
    "--to": "unknown format|--to",
    "--tasks": "task",
    "--datasets": "dataset",
    "--methods": "method",
    "--units": "unit",
    "--planners": "planners|n0nsense",
    "--data-share": "share of the data|data[-_]share",
}


def plain(kind: Any) -> tuple[Any, bool]:
    """The type that the words of an option are read as, and whether it takes several of them."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(part for part in get_args(kind) if part is not type(None))
    if get_origin(kind) is tuple:
        return get_args(kind)[0], True
    return (type(get_args(kind)[0]) if get_origin(kind) is Literal else kind), False


def options(command: type, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Names and types of all options of a command; positional ones are left out."""
    hints, full = get_type_hints(command), get_type_hints(command, include_extras=True)
    for field in fields(command):
        kind = hints[field.name]
        if is_dataclass(kind):
            own = "" if "name=''" in str(full[field.name]) else f"{prefix}{field.name}."
            yield from options(kind, own)
        elif "Positional" not in str(full[field.name]) and field.name != "plugins":
            yield f"--{prefix}{field.name}".replace("_", "-"), kind


def faults() -> Iterator[Fault]:
    for command in get_args(Subcommand):
        name = command.__name__.lower()
        for option, kind in options(command):
            if name in ("curve", "bench") and option[2:].replace("-", "_") in DECIDED:
                continue  # the study says it
            kind, _ = plain(kind)
            for value in WRONG[kind]:
                call = f"{option} {value}"
                if call in RIGHT.get(name, ()) or option in RIGHT.get(name, ()) or option in EMPTY:
                    continue
                words = (name, *BASE[name], option, value)
                word = option.removeprefix("--").rpartition(".")[2]  # a message may leave the section out
                says = SAYS.get(option, re.escape(word).replace("\\-", "[-_ ]"))
                if kind is bool:
                    says = value
                yield Fault(f"{option} {value or 'empty'}", words, says, status=(1, 2))
        for call in RIGHT.get(name, ()):
            yield Fault(f"right {call}", (name, *BASE[name], *call.split()), accepted=True)


if __name__ != "__main__":

    @pytest.mark.parametrize("fault", table(faults()))
    def test_wrong_values_of_an_option_are_refused_by_name(fault, place):
        check(fault, meet(fault, place))
