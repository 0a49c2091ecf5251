# This source code is licensed under the MIT license found in the LICENSE file.
"""Options that are read from a file: compared with the dataclass that they were written from before anything uses them.

A file may be edited by hand, cut off, or of another version. Entries that are not known, and known ones that are not
there, are nobody's fault; one of another type is named with its file.
"""

from __future__ import annotations

import types
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Union, get_args, get_origin, get_type_hints

from torchrl_koap.runs.run_directory import RunDirectoryError

# what `config.json` holds besides the options: how planner and controller are built
PLANNER = {
    "denoiser": str,
    "channels": tuple[int, ...],
    "history": int,
    "horizon": int,
    "relative": bool,
    "width": int,
    "forecast": bool,
}
CONTROLLER = {
    "method": str,
    "decoder": str | None,
    "preset": str,
    "state": str,
}
_LARGEST = 2**63 - 1


def check_config(path: str | Path, content: Mapping[str, Any]) -> None:
    """Checks what ``config.json`` of a run holds.

    Args:
        path (str or Path): the file, for the message.
        content (mapping): its content.

    Raises:
        RunDirectoryError: naming file, entry, the type that was wanted and what is there.

    Examples:
        >>> from torchrl_koap.runs.config_files import check_config
        >>> check_config("config.json", {"seed": 3, "planner": {"channels": [8, 16]}})
        >>> try:
        ...     check_config("config.json", {"planner": {"channels": 8.5}})
        ... except ValueError as error:
        ...     print(error)
        config.json is damaged: entry 'planner.channels' must be a list of int, got 8.5
    """
    from torchrl_koap.runs.config import TrainConfig  # it reads run directories itself

    kinds = get_type_hints(TrainConfig)
    kinds |= {"task": str, "planner": dict, "controller": dict, "validation_episodes": tuple[int, ...], "data": dict}
    check_types(path, content, kinds)
    parts: dict[str, Mapping[str, Any]] = {"planner": PLANNER, "controller": CONTROLLER}
    for name, inner in parts.items():
        check_types(path, content.get(name, {}), inner, prefix=f"{name}.")


def check_types(path: str | Path, content: Mapping[str, Any], kinds: Mapping[str, Any], *, prefix: str = "") -> None:
    """Checks the entries of a JSON object that are known.

    Args:
        path (str or Path): the file, for the message.
        content (mapping): the object.
        kinds (mapping): name to type, as :func:`typing.get_type_hints` returns them.

    Keyword Args:
        prefix (str): where the object lies in the file.

    Raises:
        RunDirectoryError: as :func:`check_config`.
    """
    for name, kind in kinds.items():
        if name in content and not _fits(content[name], kind):
            got = repr(content[name])
            got = got if len(got) <= 60 else f"{got[:57]}..."
            raise RunDirectoryError(f"{path} is damaged: entry '{prefix}{name}' must be {_words(kind)}, got {got}")


def _fits(value: Any, kind: Any) -> bool:
    if get_origin(kind) in (Union, types.UnionType):
        return any(_fits(value, part) for part in get_args(kind))
    if kind is type(None):
        return value is None
    if get_origin(kind) is tuple:
        return isinstance(value, (list, tuple)) and all(_fits(entry, get_args(kind)[0]) for entry in value)
    if kind is Path:
        return isinstance(value, str) and "\0" not in value
    if kind is str:
        return isinstance(value, str)
    if kind is int:
        return type(value) is int and abs(value) <= _LARGEST
    if kind is float:
        return isinstance(value, float) or (type(value) is int and abs(value) <= _LARGEST)
    return isinstance(value, kind)


def _words(kind: Any) -> str:
    if get_origin(kind) in (Union, types.UnionType):
        return " or ".join(_words(part) for part in get_args(kind))
    if get_origin(kind) is tuple:
        return f"a list of {_words(get_args(kind)[0])}"
    names = {
        type(None): "null",
        Path: "a path",
        dict: "an object",
        bool: "true or false",
        str: "text",
        float: "a number",
    }
    return names.get(kind, getattr(kind, "__name__", str(kind)))
