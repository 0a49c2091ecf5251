# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the package never unpickles, calls a shell or reads from the network."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import torchrl_koap

PACKAGE = Path(torchrl_koap.__file__).parent
ROOT = PACKAGE.parent
UNPICKLER = PACKAGE / "data/d3il/unpickling.py"
FORBIDDEN = {
    r"\btorch\.load\((?![^)]*weights_only=True)": (),
    r"allow_pickle\s*=\s*True": (),
    r"^\s*(import|from) (pickle|dill|cloudpickle|joblib|marshal|shelve)\b": (UNPICKLER,),
    r"\bpickle\.loads?\(": (),
    r"\bpickle\.dumps?\(": (),
    r"\bos\.(system|popen|exec\w+|spawn\w+)\(": (),
    r"shell\s*=\s*True": (),
    r"^\s*(import|from) (urllib|http|requests|socket|ftplib|smtplib|telnetlib)\b": (),
    r"(?<![.\w\"'`])(eval|exec)\(": (),
}


@pytest.mark.parametrize("pattern", FORBIDDEN)
def test_forbidden_calls_occur_in_no_file(pattern):
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


def pins(name):
    """Versions by name of a file of requirements."""
    lines = re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / name).read_text(), re.MULTILINE)
    return {package.lower().replace("_", "-"): version for package, version in lines}


def test_every_file_that_ci_installs_has_a_checksum_and_the_version_that_is_pinned():
    locked, pinned = pins("requirements-ci.txt"), pins("constraints.txt")
    assert "torch" not in locked  # its CPU wheel is another file than the public one of the same version
    absent = pinned.keys() - locked.keys() - {"torch"}
    lists = r"^(?:dependencies|dev) = \[.*?^\]"
    installed = "".join(re.findall(lists, (ROOT / "pyproject.toml").read_text(), re.MULTILINE | re.DOTALL))
    assert not [name for name in absent if name in installed.replace("_", "-")]  # extras that CI does without
    assert {name: pinned[name] for name in pinned.keys() & locked.keys()}.items() <= locked.items()
    entries = re.split(r"^(?=[\w.-]+==)", (ROOT / "requirements-ci.txt").read_text(), flags=re.MULTILINE)[1:]
    assert len(entries) == len(locked) > 100
    assert not [entry for entry in entries if not re.search(r"--hash=sha256:[0-9a-f]{64}", entry)]


def test_every_dependency_has_a_lowest_version():
    """Without one a resolver may take a release of ten years ago."""
    listed = re.search(r"^dependencies = \[(.*?)\]", (ROOT / "pyproject.toml").read_text(), re.MULTILINE | re.DOTALL)
    names = re.findall(r'"([^"]+)"', listed[1])
    assert len(names) > 10 and not [name for name in names if ">=" not in name]
    assert {re.match(r"[\w-]+", name)[0] for name in names} <= {*pins("requirements-ci.txt"), "torch"}
