# This source code is licensed under the MIT license found in the LICENSE file.
"""What the tests of commands share: what a folder holds, and the one line of a command that cannot be done."""

from pathlib import Path

from tiny_runs import koap


def contents(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def fails(capsys, *arguments) -> str:
    """The one line that a command which cannot be done writes to stderr."""
    capsys.readouterr()
    assert koap(*arguments) == 1
    out, err = capsys.readouterr()
    lines = err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("koap: ") and "Traceback" not in err, err
    assert out == ""
    return lines[0]
