# This source code is licensed under the MIT license found in the LICENSE file.
"""A curve on Ray whose worker is killed in the middle of a cell."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from late_files import wait_until
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


def surroundings(monkeypatch, folder: Path, short: Path) -> dict[str, str]:
    """An environment with a home of its own and no setting of Ray's."""
    (folder / "home").mkdir()
    for name in [name for name in os.environ if name.startswith("RAY_")]:
        monkeypatch.delenv(name)
    settings = {"HOME": str(folder / "home"), "TMPDIR": str(short), "MPLCONFIGDIR": str(short)}
    return os.environ | settings | {"RAY_USAGE_STATS_ENABLED": "0", "OMP_NUM_THREADS": "1"}


def curve_of(folder: Path) -> list[str]:
    """A curve of two cells on two workers."""
    data = write_demonstrations(folder / "data")
    words = [sys.executable, "-m", "torchrl_koap.commands.cli", "curve", "--out", folder / "curve", "--datasets", data]
    words += ["--methods", "linear", "koap", "--labels", "0.25", "--seeds", "1", "--evaluation.episodes", "1"]
    words += ["--planner.steps", "400", "--controller.steps", "400", "--workers", "2", "--launcher", "ray", "--quiet"]
    return list(map(str, words))


@pytest.fixture
def short():
    """A folder of a short name: that of a socket has a hundred characters at most."""
    with tempfile.TemporaryDirectory(dir="/tmp", ignore_cleanup_errors=True) as folder:
        yield Path(folder)


@pytest.mark.slow
@pytest.mark.timeout(2 * LONGEST)
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra 'ray')")
def test_a_killed_worker_costs_its_cell_alone_and_the_next_call_does_it(tmp_path, short, monkeypatch):
    settings, out = surroundings(monkeypatch, tmp_path, short), tmp_path / "curve"
    words, killed = curve_of(tmp_path), out / "cells" / "avoiding" / "koap-0.25-1-seed0"
    process = subprocess.Popen(words, env=settings)
    worker = kill_when_it_trains(killed, process)
    assert process.wait(LONGEST) == 1
    rows = {row["method"]: row for row in read_cells(out / "cells.csv")}
    assert rows["linear"]["status"] == "done" and rows["koap"]["status"] == "failed"
    assert "WorkerCrashedError" in rows["koap"]["reason"] and not Path(f"/proc/{worker}").exists()

    finished = {path: path.stat().st_mtime_ns for path in (out / rows["linear"]["run"]).rglob("*")}
    assert subprocess.run(words, env=settings, timeout=LONGEST).returncode == 0
    assert [row["status"] for row in read_cells(out / "cells.csv")] == 2 * ["done"]
    assert finished == {path: path.stat().st_mtime_ns for path in finished}
    assert not (tmp_path / "home" / ".ray").exists() and not list(short.glob("koap-ray-*"))


@contextlib.contextmanager
def cluster(folder: Path, settings: dict[str, str]):
    """The head of a cluster of two local workers and its address; killed with all that it started."""
    folder.mkdir()
    words = [str(Path(sys.executable).parent / "ray"), "start", "--head", "--block", "--num-cpus", "2", "--port", "0"]
    words += ["--include-dashboard", "false", "--temp-dir", str(folder), "--node-ip-address", "127.0.0.1"]
    with open(folder / "head.log", "w+") as said:
        head = subprocess.Popen(words, env=settings, stdout=said, stderr=said, start_new_session=True)
        try:
            ends, found = time.monotonic() + LONGEST, None
            while not found and head.poll() is None and time.monotonic() < ends:
                time.sleep(0.2)
                found = re.search(r"address='([\d.]+:\d+)'", (folder / "head.log").read_text())
            assert found, (folder / "head.log").read_text()
            yield found[1]
        finally:
            for member in group_of(head.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(member, signal.SIGKILL)
            head.wait()


def group_of(leader: int) -> list[int]:
    """All processes of the session that a process leads, itself last."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if int((process / "stat").read_text().rpartition(")")[2].split()[3]) == leader:
                found.append(int(process.name))
    return sorted(found, reverse=True)


@pytest.mark.slow
@pytest.mark.timeout(3 * LONGEST)
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra 'ray')")
def test_a_curve_goes_on_where_it_was_when_the_head_is_started_again(tmp_path, short, monkeypatch):
    settings, out = surroundings(monkeypatch, tmp_path, short) | {"RAY_AUTH_MODE": "disabled"}, tmp_path / "curve"
    words, disturbed = curve_of(tmp_path), out / "cells" / "avoiding" / "koap-0.25-1-seed0"
    with cluster(short / "first", settings) as address:
        process = subprocess.Popen([*words, "--address", address], env=settings, stderr=subprocess.PIPE, text=True)
        wait_until(lambda: (disturbed / "metrics.csv").exists() or process.poll() is not None, LONGEST)
        assert process.poll() is None
    _, said = process.communicate(timeout=LONGEST)
    assert process.returncode == 1 and "Traceback" not in said
    assert "127.0.0.1" in said.splitlines()[-1] or "Ray" in said.splitlines()[-1], said

    finished = {path: path.stat().st_mtime_ns for path in out.rglob("*.safetensors") if path.parent.name == "shared"}
    with cluster(short / "second", settings) as address:
        assert subprocess.run([*words, "--address", address], env=settings, timeout=LONGEST).returncode == 0
    assert [row["status"] for row in read_cells(out / "cells.csv")] == 2 * ["done"]
    assert finished == {path: path.stat().st_mtime_ns for path in finished}
    assert not (tmp_path / "home" / ".ray").exists()
