# This source code is licensed under the MIT license found in the LICENSE file.
"""Locks between processes."""

from __future__ import annotations

import subprocess
import sys
import threading

import pytest

from torchrl_koap.files import LockedError, one_at_a_time

HOLD = """
import sys
from torchrl_koap.files import one_at_a_time
with one_at_a_time(sys.argv[1]):
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


def test_without_a_message_the_others_wait(tmp_path):
    order = []

    def second():
        with one_at_a_time(tmp_path / "lock"):
            order.append("second")

    with one_at_a_time(tmp_path / "lock"):
        thread = threading.Thread(target=second)
        thread.start()
        thread.join(0.3)
        assert thread.is_alive()
        order.append("first")
    thread.join(10)
    assert order == ["first", "second"]
