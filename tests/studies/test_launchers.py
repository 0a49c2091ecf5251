# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests jobs in processes: order, all ways of dying, output, and no leftover processes."""

import importlib.util
import multiprocessing
import os
import re
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from late_files import wait_until

from torchrl_koap.studies import launchers
from torchrl_koap.studies.launchers import Job, Machines, launch

pytestmark = pytest.mark.usefixtures("job_server")
# where a process that no test has started finds this file and what it imports
IMPORTED_FROM = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "helpers")]


def say(folder):
    with open(Path(folder).parent / "said", "a") as out:
        out.write(f"{Path(folder).name}\n")


def sleep(folder):
    (Path(folder) / "pid").write_text(str(os.getpid()))
    time.sleep(600)


def hold_a_lock(folder):
    held = multiprocessing.RLock()  # a semaphore of the system, as those of progress bars and replay buffers
    sleep(folder)
    return held


def print_in_every_way():
    sys.stdout.write("printed\n")
    sys.stderr.write("on stderr\n")
    os.write(1, b"past Python\n")
    subprocess.run(["echo", "by a program"], check=True)


def raises(message):
    raise RuntimeError(message)


def out_of_memory():
    raise MemoryError


def be_killed():
    sys.stdout.write("so far so good\n")
    os.kill(os.getpid(), signal.SIGKILL)


DEATHS = {
    "raises": (lambda: raises("no such thing\nand more"), "RuntimeError: no such thing"),
    "killed": (be_killed, "killed by the system (signal 9): probably out of memory; try fewer --workers"),
    "leaves": (lambda: os._exit(3), "its process ended without an error message (exit code 3)"),
    "aborts": (os.abort, "its process ended without an error message (signal 6, Aborted)"),
    "memory": (out_of_memory, "MemoryError"),
    "talkative": (lambda: raises("x" * 200_000), f"RuntimeError: {'x' * 500}"),
}


def act(folder):
    name = Path(folder).name
    if name in DEATHS:
        DEATHS[name][0]()
    elif name == "speaks":
        print_in_every_way()
    elif name == "sleeps":
        sleep(folder)
    else:
        say(folder)


def is_alive(pid):
    """Whether there is such a process that still does something; the second field behind the name is its parent."""
    try:
        return stat(pid)[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def stat(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def jobs_of(root, **needs):
    return [Job(root / name, None if need is None else root / need) for name, need in needs.items()]


def reasons(jobs, **machines):
    return {job.folder.name: reason for job, reason in launch(act, jobs, Machines(**{"workers": 2} | machines))}


def test_jobs_run_in_the_order_of_their_needs(tmp_path):
    jobs = jobs_of(tmp_path, first=None, second="first", third="second")
    assert reasons(jobs, workers=3) == {"first": None, "second": None, "third": None}
    assert (tmp_path / "said").read_text().split() == ["first", "second", "third"]


def test_a_job_that_dies_takes_only_its_dependants_along_and_the_reason_says_how(tmp_path):
    after = {f"after_{name}": name for name in DEATHS}
    jobs = jobs_of(tmp_path, **dict.fromkeys(DEATHS), **after, last="after_killed", other=None)
    found = reasons(jobs)
    for name, (_, reason) in DEATHS.items():
        assert found[name] == reason
        assert found[f"after_{name}"] == f"{name} failed: {reason}"
    assert found["last"] == f"after_killed failed: killed failed: {DEATHS['killed'][1]}"
    assert found["other"] is None and (tmp_path / "said").read_text() == "other\n"
    assert len(found) == len(jobs)
    log = (tmp_path / "raises" / "log.txt").read_text()
    assert "Traceback" in log and "and more" in log
    assert (tmp_path / "killed" / "log.txt").read_text() == "so far so good\n"


def test_everything_printed_is_in_the_log_and_an_earlier_log_is_kept(tmp_path, capfd):
    log = tmp_path / "speaks" / "log.txt"
    log.parent.mkdir()
    log.write_text("earlier\n")
    assert reasons(jobs_of(tmp_path, speaks=None)) == {"speaks": None}
    lines = log.read_text().splitlines()
    assert lines[0] == "earlier" and sorted(lines[1:]) == ["by a program", "on stderr", "past Python", "printed"]
    assert capfd.readouterr() == ("", "")


def test_a_job_without_a_place_for_its_log_fails_with_a_reason(tmp_path, capfd):
    (tmp_path / "speaks").write_text("")
    found = reasons(jobs_of(tmp_path, speaks=None))
    assert "FileExistsError" in found["speaks"] and "speaks" in found["speaks"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"launcher": "lokal"}, "unknown launcher 'lokal'; did you mean 'local'?"),
        ({"workers": 0}, "workers must be >= 1, got 0"),
        ({"address": "10.0.0.1:6379"}, "launcher 'local' uses only this machine"),
    ],
)
def test_wrong_options_of_machines_raise_errors(options, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        Machines(**options)


def test_ray_that_is_not_installed_names_the_extra(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None)
    with pytest.raises(ValueError, match=r"pip install 'torchrl_koap\[ray\]'"):
        Machines(launcher="ray")


def test_no_more_jobs_run_at_a_time_than_there_are_workers(tmp_path):
    class Pool:
        workers, running, most = 2, [], 0

        def start(self, job):
            self.running.append(job)
            self.most = max(self.most, len(self.running))

        def finished(self):
            return [(self.running.pop(), None)]

        def stop(self):
            pass

    pool, jobs = Pool(), jobs_of(tmp_path, **dict.fromkeys("abcde"))
    assert {job for job, _ in launchers._schedule(list(jobs), pool)} == set(jobs) and pool.most == 2


def test_no_jobs_end_at_once():
    assert reasons([]) == {}


def test_closing_the_iterator_stops_what_is_running(tmp_path):
    file = tmp_path / "sleeps" / "pid"
    ended = launch(act, jobs_of(tmp_path, sleeps=None, quick=None), Machines(workers=2))
    assert next(ended)[0].folder.name == "quick"
    wait_until(lambda: file.exists() and file.read_text())
    pid = int(file.read_text())
    assert is_alive(pid)
    ended.close()
    wait_until(lambda: not is_alive(pid))


def test_jobs_that_are_stopped_give_back_what_they_hold_and_nothing_is_said_of_it(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        f"import sys; sys.path[:0] = {IMPORTED_FROM}\n"
        "from pathlib import Path\n"
        "from late_files import wait_until\n"
        "from torchrl_koap.studies import launchers\n"
        "from test_launchers import hold_a_lock\n"
        "if __name__ == '__main__':\n"
        f"    job = launchers.Job(Path({str(tmp_path)!r}) / 'a')\n"
        "    pool = launchers.LocalPool(hold_a_lock, 1)\n"
        "    pool.start(job)\n"
        "    wait_until((job.folder / 'pid').exists, 60)\n"
        "    pool.stop()\n"
    )
    ended = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=100)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_jobs_do_not_outlive_a_parent_that_is_killed(tmp_path):
    script = tmp_path / "parent.py"
    script.write_text(
        f"import sys; sys.path[:0] = {IMPORTED_FROM}\n"
        "from pathlib import Path\n"
        "from torchrl_koap.studies import launchers\n"
        "from test_launchers import sleep\n"
        "if __name__ == '__main__':\n"
        f"    jobs = [launchers.Job(Path({str(tmp_path)!r}) / name) for name in 'ab']\n"
        "    list(launchers.launch(sleep, jobs, launchers.Machines(workers=2)))\n"
    )
    files = [tmp_path / name / "pid" for name in "ab"]
    parent = subprocess.Popen([sys.executable, str(script)])
    try:
        wait_until(lambda: all(file.exists() and file.read_text() for file in files), 60)
        pids = [int(file.read_text()) for file in files]
        server = int(stat(pids[0])[1])
        assert all(map(is_alive, [*pids, server])) and server != parent.pid
    finally:
        parent.kill()
        parent.wait()
    try:
        wait_until(lambda: not any(map(is_alive, [*pids, server])))
    finally:
        for pid in filter(is_alive, pids):
            os.kill(pid, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra 'ray')")
def test_a_ray_cluster_does_the_same(tmp_path, monkeypatch):
    """Started for the occasion and gone afterwards; a job that dies takes its dependants along and nobody else."""
    import ray

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(IMPORTED_FROM))  # where its workers find the jobs
    (tmp_path / "token").write_text(secrets.token_hex(32))  # else Ray leaves one in the home folder
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    names = ("raises", "killed", "leaves", "memory", "speaks")
    jobs = jobs_of(tmp_path, **dict.fromkeys(names), after="speaks", never="killed")
    found = reasons(jobs, launcher="ray")
    assert found["raises"] == "RuntimeError: no such thing" and found["memory"] == "MemoryError"
    assert all("WorkerCrashedError" in found[name] for name in ("killed", "leaves"))
    assert found["never"] == f"killed failed: {found['killed']}"
    assert found["speaks"] is None and found["after"] is None and (tmp_path / "said").read_text() == "after\n"
    assert (tmp_path / "speaks" / "log.txt").read_text() == "printed\non stderr\n"
    assert (tmp_path / "killed" / "log.txt").read_text() == "so far so good\n"
    assert not ray.is_initialized()
