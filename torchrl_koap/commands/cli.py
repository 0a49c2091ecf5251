# This source code is licensed under the MIT license found in the LICENSE file.
"""The command line ``koap``: whatever goes wrong, one line on stderr says what, and the exit status says so too.

The commands themselves are imported when they are needed, so that a signal or a wrong setting while that happens is
met here as well.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from typing import Any

from torchrl_koap import __version__
from torchrl_koap.commands.shell import (
    ReadEnough,
    describe_interrupt,
    discard_output,
    handling_signals,
    interrupt,
    leave,
    one_line_warnings,
    open_closed_streams,
    widen_terminal,
    written_output,
)

# errors that speak for themselves; anything else is a fault of ours and keeps its traceback
EXPECTED = (ValueError, RuntimeError, KeyError, OSError, MemoryError)
HINT = "KOAP_TRACEBACK=1 shows where"
_SHORT = 8  # entries of a list that is printed whole
_MAY_BE_EMPTY = ("--action-units", "--state-units")  # the unit of a number without one


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a sub-command; returns the exit status.

    It is 1 for a job that could not be done, or not all of it, and 128 and the signal's number for one that was
    interrupted (130 after Ctrl-C), each with one line that says why. A wrong call leaves with 2. ``KOAP_TRACEBACK=1``
    shows where an error is from. The words are those of the process by default.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    open_closed_streams()
    try:
        with handling_signals(interrupt), one_line_warnings():
            return _run(arguments)
    except ReadEnough:  # `koap ... | head`
        discard_output()
        return 141
    except KeyboardInterrupt as error:
        message, status = describe_interrupt(error, *arguments[:1])
        _complain(message)
        return status
    except Exception as error:
        # the simulator's own error for a machine that has too little memory or no graphics derives from nothing else
        expected = isinstance(error, EXPECTED) or type(error).__module__.partition(".")[0] == "mujoco"
        if os.environ.get("KOAP_TRACEBACK") or not expected:
            raise
        _complain(f"{_one_line(error)} ({HINT})")
        return 1


def _run(arguments: Sequence[str]) -> int:
    if arguments == ["--version"]:
        with written_output():
            print(f"koap {__version__}")
        return 0
    _check_words(arguments)
    options, subcommands, without_progress_bars = _commands()
    widen_terminal()
    with written_output():
        if not arguments or arguments[0] in ("-h", "--help"):
            print(subcommands.overview(), file=sys.stdout if arguments else sys.stderr)
            return 0 if arguments else 2
        command = _parsed(options, subcommands.Subcommand, arguments)
    options.check_options(command)
    with without_progress_bars() if command.quiet else nullcontext():
        result = command()
    failed = result.pop("failed", "") if isinstance(result, dict) else ""  # said once, and whatever is quiet
    if not command.quiet:
        with written_output():
            _show(result)
    if failed:
        _complain(failed)
    return 1 if failed else 0


def _parsed(options: Any, kind: Any, arguments: Sequence[str]) -> Any:
    """The command; what one of our own checks refuses is raised as it is, what tyro refuses leaves with 2."""
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # its words for what our own checks say
            return options.parse(kind, arguments, console_outputs=False)
    except SystemExit as left:
        error = left.__context__
        while error is not None:
            if isinstance(error, ValueError) and _is_ours(error):
                raise error from None
            error = error.__cause__ or error.__context__
    try:
        options.check_call(kind, arguments)
    except ValueError as error:
        _complain(str(error))
        raise SystemExit(2) from None
    return options.parse(kind, arguments)


def _is_ours(error: BaseException) -> bool:
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return frame.f_globals["__name__"].startswith("torchrl_koap")


def _check_words(arguments: Sequence[str]) -> None:
    """Refuses empty words: an unset variable of the shell would silently mean the present folder."""
    option = arguments[0] if arguments else ""
    for word in arguments:
        if word.startswith("--"):
            option = word.partition("=")[0]
        if (word == "" or word == f"{option}=") and option not in _MAY_BE_EMPTY:
            raise ValueError(
                f"{option} is followed by an empty word: wanted a value; is a variable of the shell not set?"
            )


def _commands() -> tuple[Any, ...]:
    """What takes seconds to import."""
    if sys.flags.optimize > 1:
        raise RuntimeError(
            "Python runs with -OO (or PYTHONOPTIMIZE=2), which removes docstrings that torch and the options of"
            " `koap` are made of; use -O or nothing"
        )
    loaded = "torchrl_koap.commands.subcommands" in sys.modules
    with nullcontext() if loaded else handling_signals(leave):
        try:
            from torchrl_koap.commands import options, subcommands
            from torchrl_koap.runs.progress import without_progress_bars
        except (ImportError, AttributeError) as error:
            raise RuntimeError(f"a part of the installation cannot be imported: {error}") from error
        except ValueError as error:
            backend = os.environ.get("MPLBACKEND")
            if backend and backend in str(error):
                raise ValueError(f"MPLBACKEND={backend} is no backend of matplotlib; unset it") from error
            raise
    return options, subcommands, without_progress_bars


def _one_line(error: BaseException) -> str:
    """The message of an error, the problems it lists one after the other."""
    message = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    lines = [line.strip().removeprefix("- ") for line in message.splitlines() if line.strip()]
    said = "; ".join(lines).replace(":;", ":")
    if isinstance(error, MemoryError):
        return f"out of memory{f': {said}' if said else ''}; try fewer episodes, or smaller batches"
    return said or type(error).__name__


def _complain(message: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # a full device, a closed one
        sys.stderr.write(f"koap: {message}\n")
        sys.stderr.flush()


def _show(result: Any) -> None:
    if not isinstance(result, Mapping):
        print(result)
        return
    lines = [line for key, value in result.items() for line in _lines(key, value)]
    width = min(max((len(name) for name, _ in lines), default=0), 45)
    for name, text in lines:
        print(f"{name:<{width}}  {text}")


def _lines(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """A line per value; a mapping of plain values is one line, a nested one a line for each of its entries."""
    if isinstance(value, Mapping) and any(isinstance(entry, Mapping) for entry in value.values()):
        for key, entry in value.items():
            yield from _lines(f"{name} {key}", entry)
    elif isinstance(value, Mapping):
        yield name, ", ".join(f"{key.replace('_', ' ')} {_words(entry)}" for key, entry in value.items())
    else:
        yield name, _words(value)


def _words(value: Any) -> str:
    """A value as words; of a long list the first few entries and how many there are."""
    if isinstance(value, list):
        shown = " ".join(map(_words, value if len(value) <= _SHORT else value[:3]))
        return shown if len(value) <= _SHORT else f"{shown} ... ({len(value)} values)"
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
