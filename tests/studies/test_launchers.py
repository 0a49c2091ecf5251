# This source code is licensed under the MIT license found in the LICENSE file.
"""Jobs in processes: their order, every way in which one can die, what they print, and none that stays behind."""

from __future__ import annotations

import importlib.util
import os
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from torchrl_koap.studies.launchers import Job, check_launcher, launch, run_logged


def say(file, text):
    with open(file, "a") as out:
        out.write(f"{text}\n")


def fail(message):
    raise RuntimeError(message)


def be_killed():
    sys.stdout.write("so far so good\n")
    os.kill(os.getpid(), signal.SIGKILL)


def leave():
    os._exit(3)


def abort():
    os.abort()


def run_out_of_memory():
    raise MemoryError


def print_in_every_way():
    sys.stdout.write("printed\n")
    sys.stderr.write("on stderr\n")
    os.write(1, b"past Python\n")
    subprocess.run(["echo", "by a program"], check=True)


def sleep(file):
    Path(file).write_text(str(os.getpid()))
    time.sleep(600)


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.02)


def is_alive(pid):
    """Whether there is such a process that still does something; the second field behind the name is its parent."""
    try:
        return stat(pid)[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def stat(pid):
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def reasons(jobs, **options):
    return {job.name: reason for job, reason in launch(jobs, **options)}


def test_jobs_run_in_the_order_of_their_needs(tmp_path):
    file = tmp_path / "order"
    jobs = [
        Job("third", say, {"file": file, "text": "third"}, needs=("second", "first")),
        Job("second", say, {"file": file, "text": "second"}, needs=("first",)),
        Job("first", say, {"file": file, "text": "first"}),
    ]
    assert reasons(jobs, workers=3) == {"first": None, "second": None, "third": None}
    assert file.read_text().split() == ["first", "second", "third"]


def test_one_worker_takes_jobs_as_they_come(tmp_path):
    file = tmp_path / "order"
    assert set(reasons([Job(str(n), say, {"file": file, "text": n}) for n in range(4)], workers=1).values()) == {None}
    assert file.read_text().split() == ["0", "1", "2", "3"]


DEATHS = {
    "raises": (fail, {"message": "no such thing\nand more"}, "RuntimeError: no such thing"),
    "killed": (be_killed, {}, "killed by the system (signal 9): probably out of memory; try fewer --workers"),
    "leaves": (leave, {}, "its process ended without a word (exit code 3)"),
    "aborts": (abort, {}, "its process ended without a word (signal 6, Aborted)"),
    "memory": (run_out_of_memory, {}, "MemoryError"),
    "talkative": (fail, {"message": "x" * 200_000}, f"RuntimeError: {'x' * 500}"),
}


def test_a_job_that_dies_takes_only_its_dependants_along_and_the_reason_says_how(tmp_path):
    file = tmp_path / "others"
    jobs = [Job(name, function, arguments, tmp_path / name) for name, (function, arguments, _) in DEATHS.items()]
    jobs += [Job(f"after {name}", say, {"file": file, "text": name}, needs=(name,)) for name in DEATHS]
    jobs += [Job("last", say, {"file": file, "text": "last"}, needs=("after killed",))]
    jobs += [Job("other", say, {"file": file, "text": "other"})]
    found = reasons(jobs)
    for name, (_, _, reason) in DEATHS.items():
        assert found[name] == reason
        assert found[f"after {name}"] == f"{name} failed: {reason}"
    assert found["last"] == f"after killed failed: killed failed: {DEATHS['killed'][2]}"
    assert found["other"] is None and file.read_text() == "other\n"
    assert len(found) == len(jobs)
    assert "Traceback" in (tmp_path / "raises").read_text() and "and more" in (tmp_path / "raises").read_text()
    assert (tmp_path / "killed").read_text() == "so far so good\n"


def test_everything_printed_is_in_the_log_and_an_earlier_log_is_kept(tmp_path, capfd):
    log = tmp_path / "new" / "log.txt"
    log.parent.mkdir()
    log.write_text("earlier\n")
    assert reasons([Job("speaks", print_in_every_way, log=log)]) == {"speaks": None}
    lines = log.read_text().splitlines()
    assert lines[0] == "earlier" and sorted(lines[1:]) == ["by a program", "on stderr", "past Python", "printed"]
    assert capfd.readouterr() == ("", "")


def test_a_job_without_a_place_for_its_log_fails_with_a_reason(tmp_path, capfd):
    (tmp_path / "file").write_text("")
    found = reasons([Job("speaks", print_in_every_way, log=tmp_path / "file" / "log.txt")])
    assert "FileExistsError" in found["speaks"] and "file" in found["speaks"]
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("needs", "options", "message"),
    [
        ({"a": ()}, {"launcher": "lokal"}, "unknown launcher 'lokal'; did you mean 'local'?"),
        ({"a": ()}, {"workers": 0}, "workers must be >= 1, got 0"),
        ({"a": ()}, {"address": "10.0.0.1:6379"}, "launcher 'local' works on this machine alone"),
        ({"a": ("b",)}, {}, r"job 'a' needs \['b'\], which are no jobs"),
        ({"a": ("b",), "b": ("c",), "c": ("a",)}, {}, "jobs wait for each other: "),
        ({"a": ("a",)}, {}, "jobs wait for each other: a -> a"),
    ],
)
def test_what_cannot_be_launched_is_refused_before_anything_runs(needs, options, message, tmp_path):
    file = tmp_path / "file"
    jobs = [Job(name, say, {"file": file, "text": name}, needs=those) for name, those in needs.items()]
    with pytest.raises(ValueError, match=message):
        launch(jobs, **options)
    assert not file.exists()


def test_two_jobs_of_one_name_are_refused():
    with pytest.raises(ValueError, match=r"jobs need names of their own; twice: \['a'\]"):
        launch([Job("a", leave), Job("a", leave), Job("b", leave)])


def test_ray_that_is_not_installed_names_the_extra(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *rest: None)
    for call in (lambda: launch([], launcher="ray"), lambda: check_launcher("ray")):
        with pytest.raises(ValueError, match=r"pip install 'torchrl_koap\[ray\]'"):
            call()


def test_no_jobs_end_at_once():
    assert reasons([]) == {}


def test_closing_the_iterator_stops_what_is_running(tmp_path):
    file = tmp_path / "pid"
    ended = launch([Job("sleeps", sleep, {"file": file}), Job("quick", say, {"file": tmp_path / "x", "text": ""})])
    assert next(ended)[0].name == "quick"
    wait_for(lambda: file.exists() and file.read_text())
    pid = int(file.read_text())
    assert is_alive(pid)
    ended.close()
    wait_for(lambda: not is_alive(pid))


def test_jobs_do_not_outlive_a_parent_that_is_killed(tmp_path):
    """Neither the job nor the server that it is a copy of."""
    script = tmp_path / "parent.py"
    script.write_text(
        f"import sys; sys.path[:0] = {[str(Path(__file__).parent)]}\n"
        "from torchrl_koap.studies import launchers\n"
        "from test_launchers import sleep\n"
        "if __name__ == '__main__':\n"
        f"    jobs = [launchers.Job(name, sleep, {{'file': {str(tmp_path)!r} + '/' + name}}) for name in 'ab']\n"
        "    list(launchers.launch(jobs))\n"
    )
    files = [tmp_path / name for name in "ab"]
    parent = subprocess.Popen([sys.executable, str(script)])
    try:
        wait_for(lambda: all(file.exists() and file.read_text() for file in files), 60)
        pids = [int(file.read_text()) for file in files]
        server = int(stat(pids[0])[1])
        assert all(map(is_alive, [*pids, server])) and server != parent.pid
    finally:
        parent.kill()
        parent.wait()
    try:
        wait_for(lambda: not any(map(is_alive, [*pids, server])))
    finally:
        for pid in filter(is_alive, pids):
            os.kill(pid, signal.SIGKILL)


def test_a_function_called_with_its_words_in_a_log(tmp_path, capsys):
    assert run_logged(str(tmp_path / "log"), print, {"sep": " "}) is None
    assert run_logged(str(tmp_path / "log"), fail, {"message": ""}) == "RuntimeError"
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="ray is not installed (extra 'ray')")
def test_a_ray_cluster_does_the_same(tmp_path, monkeypatch):
    """Started for the occasion and gone afterwards; a job that dies takes its dependants along and nobody else."""
    import ray

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))  # where its workers find the jobs
    (tmp_path / "token").write_text(secrets.token_hex(32))  # else Ray leaves one in the home folder
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    file = tmp_path / "others"
    deaths = {name: DEATHS[name] for name in ("raises", "killed", "leaves", "memory")}
    jobs = [Job(name, function, arguments, tmp_path / name) for name, (function, arguments, _) in deaths.items()]
    jobs += [
        Job("speaks", print_in_every_way, log=tmp_path / "speaks"),
        Job("after", say, {"file": file, "text": "after"}, needs=("speaks",)),
        Job("never", say, {"file": file, "text": "never"}, needs=("killed",)),
    ]
    found = reasons(jobs, launcher="ray", workers=2)
    assert found["raises"] == "RuntimeError: no such thing" and found["memory"] == "MemoryError"
    assert all("WorkerCrashedError" in found[name] for name in ("killed", "leaves"))
    assert found["never"] == f"killed failed: {found['killed']}"
    assert found["speaks"] is None and found["after"] is None and file.read_text() == "after\n"
    assert (tmp_path / "speaks").read_text() == "printed\non stderr\n"
    assert (tmp_path / "killed").read_text() == "so far so good\n"
    assert not ray.is_initialized()
