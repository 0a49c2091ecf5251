# This source code is licensed under the MIT license found in the LICENSE file.
"""A curve on Ray whose worker is killed in the middle of a cell."""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tiny_runs import write_demonstrations

from torchrl_koap.studies.table import read_cells

LONGEST = 900  # s that a call may take; the workers of a busy machine need minutes to import everything


def who_writes(log: Path) -> int | None:
    """The process that has a file open."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(os.readlink(link) == str(log) for link in (process / "fd").iterdir()):
                return int(process.name)
        except OSError:  # it has ended, or is somebody else's
            continue
    return None


def kill_when_it_trains(cell: Path, process: subprocess.Popen) -> int:
    """Ends the process of a cell once its training has begun; returns its number."""
    ends = time.monotonic() + LONGEST
    while time.monotonic() < ends and process.poll() is None:
        if (cell / "metrics.csv").exists() and (worker := who_writes(cell / "log.txt")):
            os.kill(worker, signal.SIGKILL)
            return worker
        time.sleep(0.05)
    raise AssertionError(f"{cell} was never worked on; status {process.poll()}")


@pytest.mark.slow
@pytest.mark.timeout(2 * LONGEST)
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra 'ray')")
def test_a_killed_worker_costs_its_cell_alone_and_the_next_call_does_it(tmp_path, monkeypatch):
    data, out, home = write_demonstrations(tmp_path / "data"), tmp_path / "curve", tmp_path / "home"
    home.mkdir(), (tmp_path / "tmp").mkdir()
    for name in [name for name in os.environ if name.startswith("RAY_")]:
        monkeypatch.delenv(name)
    settings = {"HOME": str(home), "TMPDIR": str(tmp_path / "tmp"), "RAY_USAGE_STATS_ENABLED": "0"}
    settings |= {"MPLCONFIGDIR": str(tmp_path / "tmp"), "OMP_NUM_THREADS": "1"}
    words = [sys.executable, "-m", "torchrl_koap.commands.cli", "curve", "--out", out, "--dataset", data, "--quiet"]
    words += ["--methods", "linear,koap", "--fractions", "0.25", "--seeds", "1", "--episodes", "1", "--steps", "400"]
    words += ["--controller-steps", "400", "--workers", "2", "--launcher", "ray"]
    killed = out / "cells" / "koap-0.25-1-seed0"

    process = subprocess.Popen(list(map(str, words)), env=os.environ | settings)
    worker = kill_when_it_trains(killed, process)
    assert process.wait(LONGEST) == 1
    rows = {row["method"]: row for row in read_cells(out / "cells.csv")}
    assert rows["linear"]["status"] == "done" and rows["koap"]["status"] == "failed"
    assert "WorkerCrashedError" in rows["koap"]["reason"] and not Path(f"/proc/{worker}").exists()

    finished = {path: path.stat().st_mtime_ns for path in (out / rows["linear"]["run"]).rglob("*")}
    assert subprocess.run(list(map(str, words)), env=os.environ | settings, timeout=LONGEST).returncode == 0
    assert [row["status"] for row in read_cells(out / "cells.csv")] == 2 * ["done"]
    assert finished == {path: path.stat().st_mtime_ns for path in finished}
    assert not (home / ".ray").exists() and not list((tmp_path / "tmp").glob("koap-ray-*"))
