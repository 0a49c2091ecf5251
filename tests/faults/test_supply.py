# This source code is licensed under the MIT license found in the LICENSE file.
"""What the package never does: unpickle, call a shell, look for something on the network."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_koap

PACKAGE = Path(torchrl_koap.__file__).parent
UNPICKLER = PACKAGE / "data/d3il/unpickling.py"
RAW = PACKAGE / "data/d3il/raw.py"  # writes what D3IL's own tools read
FORBIDDEN = {
    r"\btorch\.load\((?![^)]*weights_only=True)": (),
    r"allow_pickle\s*=\s*True": (),
    r"^\s*(import|from) (pickle|dill|cloudpickle|joblib|marshal|shelve)\b": (UNPICKLER, RAW),
    r"\bpickle\.loads?\(": (),
    r"\bpickle\.dumps?\(": (RAW,),
    r"\bos\.(system|popen|exec\w+|spawn\w+)\(": (),
    r"shell\s*=\s*True": (),
    r"^\s*(import|from) (urllib|http|requests|socket|ftplib|smtplib|telnetlib)\b": (),
    r"(?<![.\w\"'`])(eval|exec)\(": (),
}


@pytest.mark.parametrize("pattern", FORBIDDEN)
def test_nothing_of_the_kind_is_written_anywhere(pattern):
    found = [
        f"{path.relative_to(PACKAGE)}:{number}: {line.strip()}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if path not in FORBIDDEN[pattern]
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if re.search(pattern, line) and not line.lstrip().startswith(("#", ">>>", "..."))
    ]
    assert not found


OFFLINE = """
import socket, sys

def refuse(*arguments, **options):
    raise AssertionError(f"the network was asked: {arguments}")

class Refused(socket.socket):
    def connect(self, address):
        if self.family != socket.AF_UNIX:
            refuse(address)
        return super().connect(address)

    connect_ex = connect

socket.socket = Refused
socket.create_connection = socket.getaddrinfo = refuse
from torchrl_koap.commands.cli import main
import torchrl_koap.evaluation, torchrl_koap.reports.html, torchrl_koap.studies.report, torchrl_koap.envs.registry
for words in (sys.argv[1].split("|")[:1], *(call.split() for call in sys.argv[1].split("|")[1:])):
    assert main(words) == 0, words
print("offline")
"""


@pytest.mark.timeout(280)
def test_nothing_is_looked_for_on_the_network(place):
    """Importing everything, checking this machine, checking data, training."""
    from tiny_runs import TINY

    train = f"train --out {place.get('out')} --dataset {place.get('data')} --quiet {' '.join(TINY)}"
    calls = f"--version|doctor|validate {place.get('data')}|{train}"
    done = subprocess.run([sys.executable, "-c", OFFLINE, calls], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.rstrip().endswith("offline"), done.stderr[-2000:]
