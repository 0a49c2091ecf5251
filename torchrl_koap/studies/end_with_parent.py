# This source code is licensed under the MIT license found in the LICENSE file.
"""Imported first by the server that worker processes are copies of: it ends with its parent, at whatever moment.

By itself it would notice the death of its parent only when it has imported everything else, seconds later.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with_parent() -> None:
    """Asks the system to kill this process when its parent ends; systems other than Linux cannot be asked."""
    if not sys.platform.startswith("linux"):
        return
    parent = os.getppid()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended in the meantime
        os._exit(1)


if sys.argv[:1] == ["-c"] and "multiprocessing.forkserver" in sys.modules:  # how such a server is started
    end_with_parent()
