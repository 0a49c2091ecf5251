# This source code is licensed under the MIT license found in the LICENSE file.
"""Handles effects of the shell: signals (all like Ctrl-C), closed streams, full devices, a terminal without columns."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from types import FrameType

# SIGHUP: the terminal was closed; exists only on Unix
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_LEAST_COLUMNS = 40  # formatting the help for a single column never ends
_RESUMING = ("demos", "embed", "curve", "bench")  # commands that resume when called again


class ReadEnough(Exception):
    """The reader of the output has closed the pipe."""


class Interrupted(KeyboardInterrupt):
    """A signal, of the given ``number``, that asks this process to end."""

    def __init__(self, number: int):
        self.number = number
        super().__init__()


def describe_interrupt(error: KeyboardInterrupt, command: str = "") -> tuple[str, int]:
    """Returns the message for an interrupted command, and the exit status that shells expect.

    The argument of the error, if any, says how to resume.
    """
    number = error.number if isinstance(error, Interrupted) else signal.SIGINT
    by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
    how = error.args or ([f"`koap {command}` resumes when called again"] if command in _RESUMING else [])
    return "; ".join([f"interrupted{by}", *how]), 128 + number


@contextlib.contextmanager
def handling_signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Calls a handler for the signals that end a process inside the block; ignored ones (``nohup``) stay ignored."""
    earlier = {number: signal.getsignal(number) for number in ENDING}
    changed = [number for number, was in earlier.items() if was not in (signal.SIG_IGN, None)]
    for number in changed:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number in changed:
            signal.signal(number, earlier[number])


@contextlib.contextmanager
def written_output() -> Iterator[None]:
    """Flushes stdout at the end of the block; raises an error if the output could not be written."""
    try:
        try:
            yield
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        raise ReadEnough from None
    except OSError as error:
        discard_output()
        raise OSError(f"the output could not be written: {error.strerror or error}") from error


def widen_terminal() -> None:
    """Sets the width of a very narrow terminal to 40 columns."""
    if shutil.get_terminal_size().columns < _LEAST_COLUMNS:
        os.environ["COLUMNS"] = str(_LEAST_COLUMNS)


@contextlib.contextmanager
def one_line_warnings() -> Iterator[None]:
    """Shows warnings inside the block as one line, without their place in the code."""
    earlier = warnings.formatwarning
    warnings.formatwarning = lambda message, *place: f"warning: {message}\n"
    try:
        yield
    finally:
        warnings.formatwarning = earlier


def open_closed_streams() -> None:
    """Opens stdin, stdout and stderr as the null device if the process was started without them (``2>&-``).

    Otherwise the next opened file would get their descriptor, and libraries would print into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            nowhere = os.open(os.devnull, os.O_RDWR)
            if nowhere != number:
                os.dup2(nowhere, number)
                os.close(nowhere)
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "r" if number == 0 else "w", encoding="utf-8", closefd=False))


def discard_output() -> None:
    """Redirects stdout to the null device: else the interpreter would report the write error again at exit."""
    if sys.stdout is sys.__stdout__:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raises :class:`Interrupted`, which is handled like Ctrl-C."""
    raise Interrupted(number)


def leave(number: int, frame: FrameType | None) -> None:
    """Ends the process at once with one line, as half imported modules cannot handle an exception."""
    message, status = describe_interrupt(Interrupted(number))
    with contextlib.suppress(OSError):
        os.write(2, f"koap: {message}\n".encode())
    os._exit(status)
