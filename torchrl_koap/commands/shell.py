# This source code is licensed under the MIT license found in the LICENSE file.
"""What a shell does to a command: signals (all are taken like Ctrl-C), closed streams, full devices, no columns."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from types import FrameType

# SIGHUP: the terminal was closed; other systems than Unix do not know it
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_LEAST_COLUMNS = 40  # the help of a terminal with a single column never ends
_GO_ON = ("demos", "embed", "curve", "bench")  # commands that go on when called again


class ReadEnough(Exception):
    """The reader of the output has gone."""


class Interrupted(KeyboardInterrupt):
    """A signal that asked this process to end; ``number`` says which."""

    def __init__(self, number: int):
        self.number = number
        super().__init__()


def describe_interrupt(error: KeyboardInterrupt, command: str = "") -> tuple[str, int]:
    """Returns what to say of an interrupt of a command, and the exit status that shells expect of it.

    Its argument, if it has one, says how to go on.
    """
    number = error.number if isinstance(error, Interrupted) else signal.SIGINT
    by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
    how = error.args or ([f"`koap {command}` goes on when called again"] if command in _GO_ON else [])
    return "; ".join([f"interrupted{by}", *how]), 128 + number


@contextlib.contextmanager
def handling_signals(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    """Calls a handler for the signals that end a process inside the block; ignored ones (``nohup``) stay ignored."""
    if threading.current_thread() is not threading.main_thread():  # Python lets nobody else
        yield
        return
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
    """Makes sure that what is printed inside has arrived when the block ends; raises an error if it has not."""
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
    """Gives the terminal a few columns at least."""
    if shutil.get_terminal_size().columns < _LEAST_COLUMNS:
        os.environ["COLUMNS"] = str(_LEAST_COLUMNS)


@contextlib.contextmanager
def one_line_warnings() -> Iterator[None]:
    """Shows a warning inside the block as one line, without its place in the code."""
    earlier = warnings.formatwarning
    warnings.formatwarning = lambda message, *place: f"warning: {message}\n"
    try:
        yield
    finally:
        warnings.formatwarning = earlier


def open_closed_streams() -> None:
    """Sends stdin, stdout and stderr nowhere if the process was started without them (``2>&-``).

    The next file that is opened would otherwise get their number, and what a library prints would land in it.
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
    """Sends what is left for stdout nowhere: the interpreter would complain about it once more when it ends."""
    if sys.stdout is sys.__stdout__:
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, sys.stdout.fileno())
            os.close(nowhere)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raises :class:`Interrupted`, which is met like Ctrl-C."""
    raise Interrupted(number)


def leave(number: int, frame: FrameType | None) -> None:
    """Ends the process with one line: half imported modules can do nothing more."""
    message, status = describe_interrupt(Interrupted(number))
    with contextlib.suppress(OSError):
        os.write(2, f"koap: {message}\n".encode())
    os._exit(status)
