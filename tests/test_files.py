# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests locks between processes, saving without loss, and errors that list every fault."""

import errno
import os
import stat
import subprocess
import sys

import pytest
from safetensors import SafetensorError

from torchrl_koap.files import DataError, LockedError, one_at_a_time, replacing_file, replacing_folder

HOLD = """
import sys
from torchrl_koap.files import one_at_a_time
with one_at_a_time(sys.argv[1], busy=""):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_another_process_is_refused_until_the_first_one_is_gone(tmp_path):
    lock = tmp_path / "deep" / "lock"
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(lock)], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert holder.stdout.readline() == b"held\n"
        with pytest.raises(LockedError, match="somebody works here"), one_at_a_time(lock, busy="somebody works here"):
            pytest.fail("both are in")
    finally:
        holder.kill()  # the system lets go of the lock however a process ends
        holder.communicate()
    with one_at_a_time(lock, busy="somebody works here"):
        pass


def test_a_file_that_cannot_be_written_leaves_the_earlier_one(tmp_path):
    path = tmp_path / "new" / "a"
    with replacing_file(path) as aside:
        aside.write_text("old")
    with pytest.raises(OSError, match="a could not be written: .*what was there before is kept"):
        with replacing_file(path) as aside:
            aside.write_text("half of it")
            raise OSError(errno.ENOSPC, "No space left on device")
    with pytest.raises(OSError, match="a could not be written: .*no room; what was there before is kept"):
        with replacing_file(path) as aside:
            raise SafetensorError("no room")  # of a full disk, too
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]
    (tmp_path / "plain").touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize("moment", ["writing", "renaming"])
def test_a_failed_folder_leaves_the_earlier_one(tmp_path, monkeypatch, moment):
    with replacing_folder(tmp_path / "set") as aside:
        (aside / "part").write_text("old")
    real, calls = os.replace, []

    def fail_second(source, target):
        calls.append(source)
        if len(calls) == 3:  # new to its place (refused: it is full), old aside, new to its place
            raise OSError(errno.ENOSPC, "No space left on device")
        real(source, target)

    with pytest.raises(OSError, match="No space left"), replacing_folder(tmp_path / "set") as aside:
        (aside / "part").write_text("new")
        if moment == "writing":
            raise OSError(errno.ENOSPC, "No space left on device")
        monkeypatch.setattr(os, "replace", fail_second)
    assert (tmp_path / "set" / "part").read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]
    monkeypatch.undo()
    with replacing_folder(tmp_path / "set") as aside:
        (aside / "part").write_text("new")
    assert (tmp_path / "set" / "part").read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]


def test_faults_are_all_told():
    assert str(DataError("a.csv", "it is empty")) == "a.csv cannot be used: it is empty"
    error = DataError("demos", ["a.csv: it is empty", "b.csv: it is missing"])
    assert str(error) == "demos cannot be used:\n  - a.csv: it is empty\n  - b.csv: it is missing"
    assert error.source == "demos" and len(error.problems) == 2
