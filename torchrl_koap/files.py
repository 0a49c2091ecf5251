# This source code is licensed under the MIT license found in the LICENSE file.
"""Saves without damaging earlier results (writes beside, then renames) and reads only plain files of bounded size."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import json
import math
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import filelock
from safetensors import SafetensorError

from torchrl_koap.lookup import lookup

_DISK_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS})
_UNIONS = (Union, UnionType)
_LARGEST_INTEGER = 2**63 - 1  # largest integer that is accepted from JSON
LARGEST = 1 << 28  # bytes; largest file that is read as a whole, hundreds of times larger than any of them


class DataError(ValueError):
    """Data cannot be used; the message lists every fault.

    Args:
        source (str or Path): the file, the folder, or another name of the data.
        problems (str or sequence of str): the faults.

    Examples:
        >>> from torchrl_koap.files import DataError
        >>> print(DataError("demos/ted", "about.json is missing"))
        demos/ted cannot be used: about.json is missing
    """

    def __init__(self, source: str | Path, problems: str | Sequence[str]):
        self.source, self.problems = str(source), [problems] if isinstance(problems, str) else list(problems)
        several = len(self.problems) > 1
        listed = "".join(f"\n  - {problem}" for problem in self.problems) if several else f" {''.join(self.problems)}"
        super().__init__(f"{source} cannot be used:{listed}")


def refuse(source: str | Path, problems: Sequence[str]) -> None:
    """Raises a :class:`DataError` with all faults of a source, if there are any."""
    if problems:
        raise DataError(source, problems)


def some(names: Sequence[object]) -> str:
    """Joins up to five names for a message: ``"a.csv, b.csv, c.csv, d.csv, e.csv and 1 more"``."""
    more = len(names) - 5
    return ", ".join(map(str, names[:5])) + (f" and {more} more" if more > 0 else "")


def gathered(faults: Iterable[tuple[str, str]]) -> list[str]:
    """Groups pairs of name and fault: returns one sentence per fault, with the first names that have it.

    Examples:
        >>> from torchrl_koap.files import gathered
        >>> gathered([("a.csv", "it is empty"), ("b.csv", "row 2 is short"), ("c.csv", "it is empty")])
        ['a.csv, c.csv: it is empty', 'b.csv: row 2 is short']
    """
    about: dict[str, list[str]] = {}
    for name, said in faults:
        about.setdefault(said, []).append(name)
    return [f"{some(names)}: {said}" for said, names in about.items()]


def option(name: str) -> str:
    """Returns the name of an option in Python and in the shell: ``"control_hz (--control-hz)"``."""
    return f"{name} (--{name.replace('_', '-')})"


def option_words(options: Mapping[str, Any], prefix: str = "--") -> Iterator[str]:
    """Yields options, also of sections, as words of a command; leaves out None, False and what is empty.

    Examples:
        >>> from torchrl_koap.files import option_words
        >>> " ".join(option_words({"seed": 1, "resume": True, "labels": {"episodes": [0, 4], "count": None}}))
        '--seed 1 --resume --labels.episodes 0 4'
    """
    for name, value in options.items():
        word = prefix + name.replace("_", "-")
        if isinstance(value, Mapping):
            yield from option_words(value, f"{word}.")
        elif name == "plugins":
            yield from (each for plugin in value for each in (f"{prefix}plugin", plugin))
        elif isinstance(value, bool):
            yield from [word] if value else ()
        elif isinstance(value, (list, tuple)):
            yield from (word, *map(str, value)) if value else ()
        elif value is not None:
            yield from (word, str(value))


def check_file(path: str | Path, *, largest: int = LARGEST) -> None:
    """Raises an OSError, with the reason, for files above ``largest`` bytes and for anything but plain files.

    Pipes and devices are excluded since reading them may never end. Links are followed.
    """
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        raise OSError(f"{path} is no plain file")
    if about.st_size > largest:
        raise OSError(f"{path} has {about.st_size:,} bytes; more than {largest:,} are not read")


def read_bytes(path: str | Path) -> bytes:
    """Reads a plain file; raises an OSError as :func:`check_file` does, or if it cannot be read."""
    check_file(path)
    return Path(path).read_bytes()


def read_json(path: str | Path) -> dict[str, Any]:
    """Reads a JSON object from a plain file.

    Raises:
        FileNotFoundError: if the file does not exist.
        DataError: if it cannot be read, or is not a JSON object.
    """
    try:
        content = json.loads(read_bytes(path))
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(path, f"it cannot be read as JSON: {error}") from error
    if not isinstance(content, dict):
        raise DataError(path, f"it must hold an object, got {type(content).__name__}")
    return content


def sha256_of(path: str | Path) -> str:
    """Computes the checksum of a file of any size, in hexadecimal."""
    check_file(path, largest=1 << 40)
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_folder(path: str | Path) -> None:
    """Checks that files can be written to a folder, which need not exist; an OSError names it and the obstacle."""
    there = next(above for above in (Path(path), *Path(path).absolute().parents) if above.exists())
    if not there.is_dir():
        raise NotADirectoryError(f"{path} cannot be made: {there} is no folder")
    try:
        tempfile.TemporaryDirectory(prefix=".", dir=there).cleanup()
    except OSError as error:
        raise OSError(f"{path} cannot be written to: {there} takes no files ({error.strerror})") from error


@contextlib.contextmanager
def replacing_file(path: str | Path) -> Iterator[Path]:
    """Yields a new, empty file, which replaces ``path`` when the block ends without an error.

    Missing parent folders are created.

    Raises:
        OSError: with the file's name, if the disk is full or cannot be written; an earlier file is kept.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = _beside(path, "tmp")
    try:
        aside.touch(exist_ok=False)
        mode = aside.stat().st_mode
        yield aside
        aside.chmod(mode)  # safetensors removes the access rights of all users but the owner
        os.replace(aside, path)
    except BaseException as error:
        aside.unlink(missing_ok=True)
        if isinstance(error, SafetensorError):  # it has no errno
            error = OSError(errno.EIO, str(error))
        if not isinstance(error, OSError) or error.errno not in _DISK_ERRORS:
            raise
        kept = "what was there before is kept" if path.exists() else "nothing of it is left"
        raise OSError(error.errno, f"{path} could not be written: {error.strerror}; {kept}") from error


@contextlib.contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """Yields a new folder beside ``path``, which replaces ``path`` when the block ends without an error."""
    path = Path(path)
    aside = _beside(path, "tmp")
    aside.mkdir(parents=True)
    try:
        yield aside
        _exchange(aside, path)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise


class LockedError(RuntimeError):
    """Another process works on a folder or file."""


@contextlib.contextmanager
def one_at_a_time(path: str | Path, *, busy: str) -> Iterator[None]:
    """Allows only one process or thread at a time to execute the block.

    The operating system releases the lock however its process ends. The lock file stays.

    Raises:
        LockedError: if another process or thread executes the block; its message is ``busy``.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        held = filelock.FileLock(path, timeout=0, thread_local=False).acquire()
    except filelock.Timeout:
        raise LockedError(busy) from None
    with held:
        yield


def _exchange(new: Path, path: Path) -> None:
    """Renames ``new`` to ``path``. A folder that is not empty cannot be the target, so it is renamed first."""
    try:
        os.replace(new, path)
        return
    except OSError:
        if not path.is_dir():
            raise
    old = _beside(path, "old")
    os.replace(path, old)
    try:
        os.replace(new, path)
    except BaseException:
        os.replace(old, path)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _beside(path: Path, ending: str) -> Path:
    """Returns a random hidden name in the same folder."""
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.{ending}")


_Made = TypeVar("_Made")


def dataclass_from_json(kind: type[_Made], content: object) -> _Made:
    """Builds a dataclass, including nested ones, from the JSON of ``dataclasses.asdict``.

    Missing fields keep their defaults, lists become tuples, and ``"inf"`` becomes infinity in a field of numbers.

    Raises:
        ValueError: if an option is unknown, missing, of the wrong type or out of range; names it.

    Examples:
        >>> from torchrl_koap.files import dataclass_from_json
        >>> from torchrl_koap.tasks import Body
        >>> dataclass_from_json(Body, {"name": "mug", "position": "mug_xy", "half": [0.1, 0.2]}).half
        (0.1, 0.2)
    """
    return _read(kind, content, "")


def _read(kind: Any, value: Any, place: str) -> Any:
    """Converts a JSON value to the type of a hint; ``place`` is its name with that of its section."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        if not isinstance(value, Mapping):
            raise ValueError(f"{place or 'the file'} must be an object, got {_short(value)}")
        hints, inside = get_type_hints(kind), f"{place}." if place else ""
        for name in value:
            lookup(hints, name, f"option of {place}" if place else "option")
        for field in dataclasses.fields(kind):
            if field.name not in value and field.default is field.default_factory is dataclasses.MISSING:
                raise ValueError(f"option {inside}{field.name} is missing")
        return kind(**{name: _read(hints[name], entry, f"{inside}{name}") for name, entry in value.items()})
    value = math.inf if value == "inf" and _fits(math.inf, kind) else value
    if not _fits(value, kind):
        raise ValueError(f"{place} must be {_words(kind)}, got {_short(value)}")
    if get_origin(kind) in _UNIONS:
        return _read(next(part for part in get_args(kind) if _fits(value, part)), value, place)
    if isinstance(value, (list, tuple)):
        return tuple(_read(one, entry, place) for one, entry in zip(_each(kind, value), value, strict=True))
    if isinstance(value, Mapping):
        inner = (Any, *get_args(kind))[-1]
        return {name: _read(inner, entry, f"{place}.{name}") for name, entry in value.items()}
    return value


def _each(kind: Any, value: Sequence[Any]) -> tuple[Any, ...]:
    """Returns the types of the entries of a tuple or list."""
    inner = get_args(kind) or (Any, ...)
    return inner[:1] * len(value) if inner[-1] is ... else inner


def _fits(value: Any, kind: Any) -> bool:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in _UNIONS:
        return any(_fits(value, part) for part in inner)
    if origin is Literal:
        return value in inner
    if origin is tuple:
        known = isinstance(value, (list, tuple)) and len(_each(kind, value)) == len(value)
        return known and all(map(_fits, value, _each(kind, value)))
    if origin is not None or dataclasses.is_dataclass(kind):
        return isinstance(value, Mapping)
    if kind is Path:
        return isinstance(value, str) and "\0" not in value
    if kind in (int, float) and type(value) is int:
        return abs(value) <= _LARGEST_INTEGER
    return kind is Any or isinstance(value, kind) and (kind is not int or type(value) is int)


def _words(kind: Any) -> str:
    origin, inner = get_origin(kind), get_args(kind)
    if origin in _UNIONS or origin is Literal:
        return " or ".join(map(_words, inner) if origin in _UNIONS else map(repr, inner))
    if origin is tuple:
        return f"a list of {_words(inner[0])}"
    if origin is not None or dataclasses.is_dataclass(kind):
        return "an object"
    names = {type(None): "null", Path: "a path", bool: "true or false", str: "text", float: "a number"}
    return names.get(kind, str(kind.__name__))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
