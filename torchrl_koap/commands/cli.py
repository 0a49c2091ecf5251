# This source code is licensed under the MIT license found in the LICENSE file.
"""The command line ``koap``: reports every failure in one line on stderr and in the exit status.

Commands are imported only when needed, so that signals and wrong settings during their import are also handled here.
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
from torchrl_koap.commands import shell

# errors whose messages suffice; any other is a bug of this package and keeps its traceback
EXPECTED = (ValueError, RuntimeError, KeyError, OSError, MemoryError)
HINT = "KOAP_TRACEBACK=1 shows where"
_SHORT = 8  # entries at most of a list that is printed whole
_MAY_BE_EMPTY = ("--action-units", "--state-units")  # "" is the unit of a dimensionless number


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a sub-command; returns the exit status.

    It is 1 after a failure, also a partial one, and 128 plus the signal's number after an interrupt (130 after Ctrl-C),
    each with one line that says why. A wrong call exits with 2. ``KOAP_TRACEBACK=1`` shows where an error comes from.
    ``arguments`` default to those of the process.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    shell.open_closed_streams()
    try:
        with shell.handling_signals(shell.interrupt), shell.one_line_warnings():
            return _run(arguments)
    except shell.ReadEnough:  # `koap ... | head`
        shell.discard_output()
        return 141
    except KeyboardInterrupt as error:
        message, status = shell.describe_interrupt(error, *arguments[:1])
        _complain(message)
        return status
    except Exception as error:
        # MuJoCo's own error, for too little memory or no graphics, derives directly from Exception
        expected = isinstance(error, EXPECTED) or type(error).__module__.partition(".")[0] == "mujoco"
        if os.environ.get("KOAP_TRACEBACK") or not expected:
            raise
        _complain(f"{_one_line(error)} ({HINT})")
        return 1


def _run(arguments: Sequence[str]) -> int:
    if arguments == ["--version"]:
        with shell.written_output():
            print(f"koap {__version__}")
        return 0
    _check_words(arguments)
    options, subcommands, without_progress_bars = _commands()
    shell.widen_terminal()
    with shell.written_output():
        if not arguments or arguments[0] in ("-h", "--help"):
            print(subcommands.overview(), file=sys.stdout if arguments else sys.stderr)
            return 0 if arguments else 2
        command = _parsed(options, subcommands.Subcommand, arguments)
    options.check_options(command)
    with without_progress_bars() if command.quiet else nullcontext():
        result = command()
    failed = result.pop("failed", "") if isinstance(result, dict) else ""  # printed once, even with --quiet
    if not command.quiet:
        with shell.written_output():
            _show(result)
    if failed:
        _complain(failed)
    return 1 if failed else 0


def _parsed(options: Any, kind: Any, arguments: Sequence[str]) -> Any:
    """Returns the command; errors of this package's checks are raised unchanged, those of tyro exit with 2."""
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # tyro would print errors of our own checks, too
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
    """Refuses empty words: an unset shell variable would silently mean the current folder."""
    option = arguments[0] if arguments else ""
    for word in arguments:
        if word.startswith("--"):
            option = word.partition("=")[0]
        if (word == "" or word == f"{option}=") and option not in _MAY_BE_EMPTY:
            raise ValueError(f"{option} is followed by an empty word: wanted a value; is a shell variable not set?")


def _commands() -> tuple[Any, ...]:
    """Imports and returns the modules that take seconds to import."""
    with shell.handling_signals(shell.leave):
        try:
            from torchrl_koap.commands import options, subcommands
            from torchrl_koap.runs.progress import without_progress_bars
        except (ImportError, AttributeError) as error:
            raise RuntimeError(f"a part of the installation cannot be imported: {error}") from error
    return options, subcommands, without_progress_bars


def _one_line(error: BaseException) -> str:
    """Returns the message of an error in one line, with listed problems joined by "; "."""
    message = str(error.args[0] if isinstance(error, KeyError) and error.args else error)
    lines = [line.strip().removeprefix("- ") for line in message.splitlines() if line.strip()]
    said = "; ".join(lines).replace(":;", ":")
    if isinstance(error, MemoryError):
        return f"out of memory{f': {said}' if said else ''}; try fewer episodes, or smaller batches"
    return said or type(error).__name__


def _complain(message: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # a full device, a closed stream
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
    """Yields a line per value; a mapping of plain values gives one line, a nested one a line per entry."""
    if isinstance(value, Mapping) and any(isinstance(entry, Mapping) for entry in value.values()):
        for key, entry in value.items():
            yield from _lines(f"{name} {key}", entry)
    elif isinstance(value, Mapping):
        yield name, ", ".join(f"{key.replace('_', ' ')} {_words(entry)}" for key, entry in value.items())
    else:
        yield name, _words(value)


def _words(value: Any) -> str:
    """Formats a value; of a long list the first three entries and the number of all."""
    if isinstance(value, list):
        shown = " ".join(map(_words, value if len(value) <= _SHORT else value[:3]))
        return shown if len(value) <= _SHORT else f"{shown} ... ({len(value)} values)"
    if value is None:
        return "none"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    sys.exit(main())
