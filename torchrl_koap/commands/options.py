# This source code is licensed under the MIT license found in the LICENSE file.
"""Common parts of all commands: their base class, how options are read and explained, and checks of their values."""

from __future__ import annotations

import contextlib
import io
import math
import re
import shlex
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, make_dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    MISSING_NONPROP,
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from torchrl_koap.evaluation.config import EvalConfig
from torchrl_koap.files import check_folder, option_words, read_json
from torchrl_koap.lookup import lookup
from torchrl_koap.modules import PRESETS
from torchrl_koap.runs.config import TrainConfig
from torchrl_koap.runs.config_files import FACTS, from_json
from torchrl_koap.studies.study import DECIDED, Study

LARGEST = 2**53  # larger whole numbers are not exact as floats
_MAY_BE_INFINITE = ("limits",)
AMOUNTS = ("--labels", "--labels.fraction", "--labels.count", "--labels.episodes")  # only one may be given
Config = TypeVar("Config")
# the fields of a configuration are options of the command itself: `--steps`, not `--config.steps`
Options = Annotated[Config, tyro.conf.arg(name="")]
# short names of the options of `koap train` that are in a section
SHORT = {
    "--preset": "controller.preset",
    "--steps": "planner.steps",
    "--strategy": "execution.strategy",
    **{f"--{name}": f"run.{name}" for name in ("seed", "device", "threads", "resume", "logger")},
    "--plugin": "run.plugins",
}
# what `koap train --help` shows
FIRST = {
    "out": (Path, "run directory to write."),
    "dataset": (Path, "folder with demonstrations, such as `koap demos` or `koap convert` write."),
    "task": (str, "name of the task (default: that of the data set)."),
    "method": (str, "koap, linear, dd, dp, mpc, ... (default: the task's)."),
    "labels": (float, "labels that may be seen: 5 trajectories, or 0.02 of them (default: all)."),
    "preset": (str, f"variant of KOAP: {', '.join(PRESETS)} (default: the task's)."),
    "steps": (int, "updates of the planner at most (default: the task's)."),
    "seed": (int, "seed of label choice, initialisation and batches (default: 0)."),
    "device": (str, "cpu or cuda (default: cpu)."),
    "threads": (int, "torch threads (default: OMP_NUM_THREADS where it is set, else 1)."),
    "resume": (bool, "resume an interrupted run."),
    "config": (Path, "JSON file of options, in the sections of `--help-all`; options of the call override it."),
}
_PLACEHOLDERS = {int: "N", float: "NUMBER", str: "NAME", Path: "PATH"}


@dataclass(kw_only=True)
class Command:
    """A command of ``koap``: its fields are options, calling it does the work and returns the output to print.

    Attributes:
        quiet: no progress bars, and no table at the end.
    """

    quiet: bool = False


def check_options(options: Any) -> None:
    """Refuses numbers that are NaN, infinite (except limits) or beyond 2^53, and an ``out`` that is not writable."""
    for field in fields(options):
        value, option = getattr(options, field.name), f"--{field.name.replace('_', '-')}"
        if is_dataclass(value):
            check_options(value)
        for number in value if isinstance(value, tuple) else (value,):
            if number == math.inf and field.name in _MAY_BE_INFINITE:
                continue
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{option} must be a finite number, got {number}")
            if isinstance(number, (int, float)) and abs(number) > LARGEST:
                raise ValueError(f"{option} must be at most {LARGEST:,}, got {number:,}")
        if field.name == "out" and value is not None:
            try:
                check_folder(value)
            except OSError as error:
                raise ValueError(f"{option} {error}") from error


def expand(words: Sequence[str]) -> list[str]:
    """Replaces ``--labels NUMBER`` by the option of its kind, and ``--config FILE`` by the options in the file.

    ``--labels 0.02`` becomes ``--labels.fraction 0.02``. Raises a ValueError for a file that is missing or holds
    anything but options, and for ``--labels`` without a number.
    """
    found: list[str] = []
    from_file: list[str] = []
    amounts = [name for name in (word.partition("=")[0] for word in words) if name in AMOUNTS]
    if "--labels" in amounts and set(amounts) != {"--labels"}:
        raise ValueError(f"give one of {', '.join(AMOUNTS)}, got {' and '.join(amounts)}")
    rest = iter(words)
    for word in rest:
        name, equals, value = word.partition("=")
        if name == "--help-all":
            found.append("--help")
        elif name in ("--labels", "--config"):
            value = value if equals else next(rest, "")
            if name == "--config":
                from_file += _words_of(Path(value), amounts)
            else:
                found += [f"--labels.{_kind_of(value)}", value]
        else:
            found.append(word)
    return [*from_file, *found]


def _kind_of(labels: str) -> str:
    for kind, number in (("count", int), ("fraction", float)):
        with contextlib.suppress(ValueError):
            number(labels)
            return kind
    raise ValueError(f"--labels must be a number of trajectories such as 5, or a share such as 0.02, got {labels!r}")


def _words_of(path: Path, amounts: Sequence[str]) -> list[str]:
    if not path.is_file():
        raise ValueError(f"--config {path}: there is no such file")
    options = {name: value for name, value in read_json(path).items() if name not in FACTS}
    if amounts and isinstance(labels := options.get("labels"), Mapping):
        replaced = [*AMOUNTS, "--labels.unit"] if "--labels" in amounts else AMOUNTS  # --labels 5: 5 trajectories
        options["labels"] = {name: value for name, value in labels.items() if f"--labels.{name}" not in replaced}
    from_json(TrainConfig, {"out": ""} | options, path)
    return list(option_words(options))


def parse(kind: Any, arguments: Sequence[str], **how: Any) -> Any:
    """Makes a command from the words of a call; ``kind`` is a dataclass, or a union of which the first word chooses.

    ``--help`` among the words prints the options and exits with 0; a wrong call exits with 2. ``how`` are further
    arguments of :func:`tyro.cli`.
    """
    arguments, short, left_out = list(arguments), dict[Any, str](), set[Any]()
    if arguments[:1] == ["train"] and {"-h", "--help"} & set(arguments):
        about = "Train planner and controller. `koap train --help-all` shows every option."
        kind, arguments, how = _first_page(), ["--help"], how | {"prog": "koap train", "description": about}
    elif arguments[:1] == ["train"]:
        sections = get_type_hints(TrainConfig)
        short = {(sections[path.split(".")[0]], path.split(".")[1]): option for option, path in SHORT.items()}
        arguments = ["train", *expand(arguments[1:])]
    elif arguments[:1] in (["curve"], ["bench"]):
        names = ("env", "env_kwargs", "num_envs", "success_key", "episodes")
        short = {(EvalConfig, name): f"--{name.replace('_', '-')}" for name in names}
        sections = get_type_hints(Study)
        left_out = {(sections[section], name) for section, name in (path.split(".") for path in DECIDED)}
        left_out |= {(Study, "preset")} if arguments[0] == "bench" else set()  # --table chooses it
    registry = ConstructorRegistry()
    registry.struct_rule(partial(_described, short, left_out, []))
    return tyro.cli(kind, args=arguments, registry=registry, **({"prog": "koap"} | how))


def training_call(dataset: Path, name: str) -> str:
    """Returns the shell command that trains on a data set; the run has the name of the task."""
    return shlex.join(["koap", "train", "--dataset", str(dataset), "--out", f"runs/{name}"])


def check_call(kind: Any, arguments: Sequence[str]) -> None:
    """Checks that a call names a command and options that its help lists, with numbers where the help wants them."""
    command = next(iter(arguments), "-")
    if command.startswith("-"):
        return
    lookup([each.__name__.lower() for each in get_args(kind)], command, "command")
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown), contextlib.suppress(SystemExit):
        parse(kind, [command, "--help-all" if command == "train" else "--help"])
    lines = re.findall(r"^[│ ]*(-.*)", shown.getvalue(), re.MULTILINE)
    wanted = {name: kind for line in lines for name, kind in re.findall(r"(--\w[\w.-]*)(?: (N|NUMBER)\b)?", line)}
    more = ["--labels", "--config", "--help-all"] if command == "train" else []
    option = ""
    for word in arguments[1:]:
        name, equals, value = word.partition("=")
        if name.startswith("--"):
            name, known, what = name.replace("_", "-"), [*wanted, *more], f"option of koap {command}:"
            inside = [each for each in wanted if each.endswith(f".{name[2:]}")]  # the same name in a section
            if name not in known and inside:
                raise ValueError(f"unknown {what} {name!r}; did you mean {' or '.join(map(repr, inside))}?")
            option = lookup(known, name, what)
        if wanted.get(option) and (equals or not name.startswith("--")):
            given = value if equals else word
            number, words = {"N": (int, "a whole number"), "NUMBER": (float, "a number")}[wanted[option]]
            try:
                number(given)
            except ValueError:
                raise ValueError(f"{option} must be {words}, got {given!r}") from None


def _first_page() -> type:
    options: list[Any] = []
    for name, (kind, about) in FIRST.items():
        default = [] if name == "out" else [False if kind is bool else None]
        options.append(
            (name, Annotated[kind | None if default == [None] else kind, tyro.conf.arg(help=about)], *default)
        )
    return make_dataclass("Train", options, kw_only=True)


def _described(
    short: Mapping[Any, str], left_out: Container[Any], inside: list[Any], info: StructTypeInfo
) -> StructConstructorSpec | None:
    """Returns tyro's specification of a dataclass, with plain placeholders and short names, without some fields."""
    if inside or not is_dataclass(info.type):
        return None
    inside.append(info)  # makes the nested call return None, so that tyro applies its own rules
    spec: Any = ConstructorRegistry.get_struct_spec(info)
    inside.clear()
    shown = [each for each in spec.fields if (info.type, each.name) not in left_out]
    return replace(spec, fields=tuple(_option(each, short.get((info.type, each.name))) for each in shown))


def _option(spec: StructFieldSpec, short: str | None) -> StructFieldSpec:
    kind: Any = spec.type
    base, *rest = get_args(kind) if get_origin(kind) is Annotated else (kind,)
    name = spec.name.upper() if spec.default in (tyro.MISSING, MISSING_NONPROP) else f"[{spec.name.upper()}]"
    about = tyro.conf.arg(
        metavar=_placeholder(base, name if tyro.conf.Positional in rest else None),
        help_behavior_hint=None if tyro.conf.UseAppendAction in rest else _default,
        aliases=[short] if short else None,
    )
    flag = [tyro.conf.FlagCreatePairsOff] if spec.default is False else []
    return replace(spec, type=Annotated[(base, about, *flag, *rest)])


def _placeholder(kind: Any, name: str | None) -> str | None:
    """Returns N, NAME, ... or the given name; with dots if several values follow."""
    inner = [part for part in get_args(kind) if part is not type(None)]
    if get_origin(kind) is tuple:
        return f"{_placeholder(inner[0], name)} ..."
    return _placeholder(inner[0], name) if inner else name or _PLACEHOLDERS.get(kind)


def _default(value: str) -> str:
    return "" if value in ("None", "False", "") else f"(default: {value})"
