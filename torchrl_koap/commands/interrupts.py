# This source code is licensed under the MIT license found in the LICENSE file.
"""Signals that end a command: all are taken like Ctrl-C, so that files and worker processes are left in order."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType

# SIGHUP: the terminal was closed; other systems than Unix do not know it
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
KEPT = "`koap train --resume` goes on from its last checkpoint, `koap demos` and `koap curve` when called again"


class Interrupted(KeyboardInterrupt):
    """A signal that asked this process to end; ``number`` says which."""

    def __init__(self, number: int):
        self.number = number
        super().__init__(number)


def describe_interrupt(error: KeyboardInterrupt) -> tuple[str, int]:
    """What to say of an interrupt, and the exit status that shells expect of it.

    Examples:
        >>> import signal
        >>> from torchrl_koap.commands.interrupts import Interrupted, describe_interrupt
        >>> describe_interrupt(Interrupted(signal.SIGTERM))[0].partition(";")[0]
        'interrupted by SIGTERM'
    """
    number = error.number if isinstance(error, Interrupted) else signal.SIGINT
    by = "" if number == signal.SIGINT else f" by {signal.Signals(number).name}"
    return f"interrupted{by}; {KEPT}", 128 + number


@contextlib.contextmanager
def ending_like_ctrl_c() -> Iterator[None]:
    """Inside the block SIGTERM and SIGHUP raise :class:`Interrupted`; one that is ignored (``nohup``) stays ignored."""
    with _handled(_raise_interrupted):
        yield


@contextlib.contextmanager
def ending_at_once() -> Iterator[None]:
    """Inside the block a signal ends the process with one line: modules that are half imported can do nothing more."""
    with _handled(_leave):
        yield


@contextlib.contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
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


def _raise_interrupted(number: int, frame: FrameType | None) -> None:
    raise Interrupted(number)


def _leave(number: int, frame: FrameType | None) -> None:
    message, status = describe_interrupt(Interrupted(number))
    with contextlib.suppress(OSError):
        os.write(2, f"koap: {message}\n".encode())
    os._exit(status)
