# This source code is licensed under the MIT license found in the LICENSE file.
"""Helper functions of command tests: contents of a folder, and the error line of a failing command."""

from pathlib import Path

from tiny_runs import koap


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def fails(capsys, *arguments) -> str:
    """Runs a command that must fail; returns the single line that it writes to stderr."""
    capsys.readouterr()
    assert koap(*arguments) == 1
    out, err = capsys.readouterr()
    lines = err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("koap: ") and "Traceback" not in err, err
    assert out == ""
    return lines[0]
