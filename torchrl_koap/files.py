# This source code is licensed under the MIT license found in the LICENSE file.
"""Saving that never damages an earlier result (write aside, then rename), and reading that always comes to an end."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import hashlib
import os
import shutil
import stat
import tempfile
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import filelock

_NO_PLACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS})
LARGEST = 1 << 28  # bytes of a file that is read as a whole: hundreds of times what any of them has


class DataError(ValueError):
    """Data that cannot be used, with every fault that was found.

    Args:
        source (str or Path): what cannot be used: a file, a folder, or what the caller calls the whole.
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


def some(names: Sequence[str], most: int = 5) -> str:
    """Joins names for a message, the first few of them.

    Args:
        names (sequence of str): the names.
        most (int): how many are named.

    Examples:
        >>> from torchrl_koap.files import some
        >>> some(["a.csv", "b.csv", "c.csv"], 2)
        'a.csv, b.csv and 1 more'
    """
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def gathered(faults: Iterable[tuple[str, str]]) -> list[str]:
    """Puts faults of many things into sentences, each once with the first of those that it is about.

    Args:
        faults (iterable of tuple): names of things, and what is wrong with them.

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
    """Says what an option is called, in Python and in the shell.

    Examples:
        >>> from torchrl_koap.files import option
        >>> option("control_hz")
        'control_hz (--control-hz)'
    """
    return f"{name} (--{name.replace('_', '-')})"


def check_file(path: str | Path, *, largest: int = LARGEST) -> None:
    """Refuses what is no plain file (a pipe never ends, nor does a device), and files of more than ``largest`` bytes.

    Args:
        path (str or Path): the file; a link is followed.
        largest (int): bytes it may have.

    Raises:
        OSError: naming the file and what it is.
    """
    about = os.stat(path)
    if not stat.S_ISREG(about.st_mode):
        raise OSError(f"{path} is no plain file")
    if about.st_size > largest:
        raise OSError(f"{path} has {about.st_size:,} bytes; more than {largest:,} are not read")


def read_bytes(path: str | Path) -> bytes:
    """Reads a plain file; an OSError refuses it as :func:`check_file` does, or if it cannot be read."""
    check_file(path)
    return Path(path).read_bytes()


def sha256_of(path: str | Path) -> str:
    """Computes the checksum of a file of any size, in hexadecimal."""
    check_file(path, largest=1 << 40)
    digest = hashlib.sha256()
    with open(path, "rb") as file:
        while part := file.read(1 << 20):
            digest.update(part)
    return digest.hexdigest()


@contextlib.contextmanager
def replacing_file(path: str | Path) -> Iterator[Path]:
    """Gives a path to write to; the file takes the place of ``path`` when the block ends without an error.

    Args:
        path (str or Path): the file to create or replace. Missing parent folders are created.

    Yields:
        Path: a new, empty file in the same folder.

    Raises:
        OSError: naming the file, if the disk is full or refuses; what was there before is kept.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with _naming(path):
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        os.close(handle)
        aside = Path(name)
        try:
            yield aside
            aside.chmod(0o666 & ~_umask())  # mkstemp makes files that only their owner can read
            os.replace(aside, path)
        except BaseException:
            aside.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def replacing_folder(path: str | Path) -> Iterator[Path]:
    """Gives a folder to write into, beside ``path``, whose place it takes when the block ends without an error."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent))
    try:
        yield aside
        aside.chmod(0o777 & ~_umask())
        _exchange(aside, path)
    except BaseException:
        shutil.rmtree(aside, ignore_errors=True)
        raise


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Says which file could not be written, and that nothing was lost."""
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_PLACE:
            raise
        kept = "what was there before is kept" if path.exists() else "nothing of it is left"
        raise OSError(error.errno, f"{path} could not be written: {error.strerror}; {kept}") from error


class LockedError(RuntimeError):
    """A folder or file that another process works on."""


@contextlib.contextmanager
def one_at_a_time(path: str | Path, *, busy: str) -> Iterator[None]:
    """Lets one process, or thread, at a time into the block and refuses the others.

    The lock is the system's: it is free again however its process ends.

    Args:
        path (str or Path): the lock file; it stays. Missing parent folders are created.
        busy (str): message of the refusal.

    Raises:
        LockedError: if somebody else is in the block.
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
    """Renames ``new`` to ``path``; a folder cannot be renamed onto a full one, so the old one steps aside first."""
    try:
        os.replace(new, path)
        return
    except OSError:
        if not path.is_dir():
            raise
    old = Path(tempfile.mkdtemp(prefix=f".{path.name}.", suffix=".old", dir=path.parent))
    try:
        os.replace(path, old)
        os.replace(new, path)
    except BaseException:
        if any(old.iterdir()) and not path.exists():
            os.replace(old, path)
        raise
    finally:
        shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


_Made = typing.TypeVar("_Made")


def dataclass_from_json(kind: type[_Made], entries: object, what: str) -> _Made:
    """Builds a dataclass, and those that its fields hold, from what ``json`` read of ``dataclasses.asdict``.

    Args:
        kind (type): the dataclass.
        entries (object): what was read; lists become tuples.
        what (str): what it is; messages begin with it.

    Raises:
        ValueError: if the entries are no object, or one of them is unknown or missing.

    Examples:
        >>> from torchrl_koap.files import dataclass_from_json
        >>> from torchrl_koap.tasks import Body
        >>> dataclass_from_json(Body, {"name": "mug", "position": "mug_xy", "half": [0.1, 0.2]}, "body").half
        (0.1, 0.2)
    """
    if not isinstance(entries, dict):
        raise ValueError(f"{what}: wanted an object, got {type(entries).__name__}")
    fields = {field.name: field for field in dataclasses.fields(typing.cast("typing.Any", kind))}
    unknown = [name for name in entries if name not in fields]
    if unknown:
        raise ValueError(f"{what}: unknown entry {unknown[0]!r}; known: {', '.join(sorted(fields))}")
    for name, field in fields.items():
        if name not in entries and field.default is field.default_factory is dataclasses.MISSING:
            raise ValueError(f"{what}: entry {name!r} is missing")
    hints = typing.get_type_hints(kind)
    return kind(**{name: _as_hinted(hints[name], value, f"{what}.{name}") for name, value in entries.items()})


def _as_hinted(hint: typing.Any, value: typing.Any, what: str) -> typing.Any:
    """A value of JSON as the type hint of its field has it: dataclasses, tuples of them, and mappings to them."""
    inner = typing.get_args(hint)
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        hint = next((one for one in inner if dataclasses.is_dataclass(one)), None)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint) and value is not None:
        return dataclass_from_json(hint, value, what)
    if isinstance(value, dict):
        each = inner[1] if typing.get_origin(hint) in (dict, Mapping) else None
        return {name: _as_hinted(each, entry, what) for name, entry in value.items()}
    if isinstance(value, (list, tuple)):
        each = inner[0] if typing.get_origin(hint) is tuple else None
        return tuple(_as_hinted(each, entry, what) for entry in value)
    return value
