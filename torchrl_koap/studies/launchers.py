# This source code is licensed under the MIT license found in the LICENSE file.
"""Many independent jobs, in processes of this machine or on a Ray cluster. A failed job does not stop the others.

Imported first by the server that worker processes are copies of: :func:`end_with_parent` is its first act.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib.util
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import connection, forkserver
from pathlib import Path
from typing import Any, TextIO

from torchrl_koap.lookup import lookup

_PR_SET_PDEATHSIG = 1  # linux/prctl.h
_LONGEST = 500  # characters of a reason
_PATIENCE = 3  # seconds in which a process may give back what it holds of the system, such as semaphores
LAUNCHERS = ("local", "ray")


def end_with_parent() -> None:
    """Kills this process when its parent ends, at whatever moment; systems other than Linux cannot be asked to."""
    if not sys.platform.startswith("linux"):
        return
    parent = os.getppid()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it has ended in the meantime
        os._exit(1)


if sys.argv[:1] == ["-c"] and "multiprocessing.forkserver" in sys.modules:  # how such a server is started
    # by itself it would notice the death of its parent only when it has imported everything else, seconds later
    end_with_parent()


@dataclass(frozen=True)
class Job:
    """A folder that says what is to be done; what is printed is appended to its ``log.txt``."""

    folder: Path
    needs: Path | None = None  # folder of the job that must have succeeded before


@dataclass(frozen=True)
class Machines:
    """Where the cells of a study are made.

    Attributes:
        workers: cells at a time (default: one per core; a cluster given by its address decides for itself).
        launcher: "local" or "ray" (extra `ray`; the folders must be visible to all machines).
        address: of a Ray cluster (default: one on this machine).

    Raises:
        ValueError: for an unknown launcher, no workers, or an address that is of no use; for one that is not installed,
            naming its extra.
    """

    workers: int | None = None
    launcher: str = "local"
    address: str | None = None

    def __post_init__(self):
        lookup(LAUNCHERS, self.launcher, "launcher")
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be >= 1, got {self.workers}")
        if self.launcher == "local" and self.address is not None:
            raise ValueError("an address was given, but launcher 'local' works on this machine alone")
        if self.launcher == "ray" and importlib.util.find_spec("ray") is None:
            raise ValueError("launcher 'ray' needs an extra: pip install 'torchrl_koap[ray]'")


def launch(
    function: Callable[[str], None], jobs: Sequence[Job], machines: Machines
) -> Generator[tuple[Job, str | None], None, None]:
    """Calls a function in every job's folder, each in a process of its own; yields jobs as they end, and why they fail.

    The function is one of a module, of a folder. Jobs that come first are started first; one whose need, a job before
    it, failed is not run and fails too. Closing the iterator stops what is running.
    """
    # a job of a cluster may not use all cores of its machine
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if machines.launcher == "ray":
        return _schedule(list(jobs), RayPool(function, machines.workers or cores, machines.address))
    return _schedule(list(jobs), LocalPool(function, machines.workers or cores))


def _schedule(waiting: list[Job], pool: Any) -> Generator[tuple[Job, str | None], None, None]:
    succeeded: set[Path | None] = {None}
    failed: dict[Path | None, str] = {}
    running = 0
    try:
        while waiting or running:
            for job in [job for job in waiting if job.needs in failed]:
                waiting.remove(job)
                failed[job.folder] = f"{job.needs.name} failed: {failed[job.needs]}"
                yield job, failed[job.folder]
            for job in [job for job in waiting if job.needs in succeeded][: pool.workers - running]:
                waiting.remove(job)
                pool.start(job)
                running += 1
            if not running:
                continue
            for job, reason in pool.finished():
                running -= 1
                if reason is None:
                    succeeded.add(job.folder)
                else:
                    failed[job.folder] = reason
                yield job, reason
    finally:
        pool.stop()


def run_logged(function: Callable[[str], None], folder: str) -> str | None:
    """Calls a function of a folder with everything it prints going to its log; returns why it failed, if it did."""
    try:
        with _open_log(folder) as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                function(folder)
            except Exception:
                traceback.print_exc(file=file)
                raise
    except Exception as error:  # also where there is no place for a log
        return _in_words(error)
    return None


def _open_log(folder: str) -> TextIO:
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder, "log.txt").open("a", buffering=1)  # by lines: a job that is killed has said what it did


def _in_words(error: Exception) -> str:
    """Type and first line; cut, as a pipe holds 64 KB and nobody reads it before the process has ended."""
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0][:_LONGEST]}".removesuffix(": ")


class LocalPool:
    """Processes that are copies of a server which has imported everything: a job starts in a fraction of a second."""

    def __init__(self, function: Callable[[str], None], workers: int):
        self.function, self.workers = function, workers
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["torchrl_koap.studies.launchers", function.__module__])
        earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # Ctrl-C is this process's to handle
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, earlier)
        self.running: dict[Any, tuple[Job, Any, Any]] = {}

    def start(self, job: Job) -> None:
        """Starts a job."""
        reader, writer = self.context.Pipe(duplex=False)
        process = self.context.Process(target=_child, args=(writer, self.function, str(job.folder)))
        process.start()
        writer.close()
        self.running[process.sentinel] = (job, process, reader)

    def finished(self) -> list[tuple[Job, str | None]]:
        """Waits for jobs to end; returns them with the reasons of those that failed."""
        ended = []
        for sentinel in connection.wait(list(self.running)):
            job, process, reader = self.running.pop(sentinel)
            process.join()
            try:
                reason = reader.recv() if reader.poll() else _death(process.exitcode)
            except (EOFError, OSError):  # a pipe at its end is ready to be read as well
                reason = _death(process.exitcode)
            reader.close()
            ended.append((job, reason))
        return ended

    def stop(self) -> None:
        """Ends what is running, and kills what does not end."""
        for _, process, _ in self.running.values():
            process.terminate()
        for _, process, _ in self.running.values():
            process.join(_PATIENCE)
            process.kill()
            process.join()
        self.running.clear()


def _death(exit_code: int) -> str:
    if exit_code == -signal.SIGKILL:
        return "killed by the system (signal 9): probably out of memory; try fewer --workers"
    what = f"exit code {exit_code}" if exit_code >= 0 else f"signal {-exit_code}, {signal.strsignal(-exit_code)}"
    return f"its process ended without a word ({what})"


def _child(writer: Any, function: Callable[[str], None], folder: str) -> None:
    # ends with a killed parent: else the next `koap curve` in the folder would find it still writing
    threading.Thread(target=_die_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    with contextlib.suppress(OSError), _open_log(folder) as file:  # what is not Python prints past sys.stdout
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
    writer.send(run_logged(function, folder))
    writer.close()


def _die_with_parent() -> None:
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGKILL)


class RayPool:
    """Tasks of a Ray cluster; a task that dies is not tried again.

    A cluster that runs, given by its address, decides by itself how many there are at a time.
    """

    def __init__(self, function: Callable[[str], None], workers: int, address: str | None):
        import ray  # the extra

        self.ray, self.function = ray, function
        self.owned = not ray.is_initialized()
        if self.owned:
            # "local", as None means a cluster that happens to run already, which takes no sizes
            size = {} if address is not None else {"num_cpus": workers, "include_dashboard": False}
            with _keeping_signals():
                ray.init(address=address or "local", log_to_driver=False, **size)
        self.workers = max(int(ray.cluster_resources().get("CPU", workers)), 1)
        self.task = ray.remote(num_cpus=1, max_retries=0)(run_logged)
        self.running: dict[Any, Job] = {}

    def start(self, job: Job) -> None:
        """Starts a job."""
        self.running[self.task.remote(self.function, str(job.folder.absolute()))] = job

    def finished(self) -> list[tuple[Job, str | None]]:
        """Waits for a job to end; returns it with the reason if it failed."""
        (reference,), _ = self.ray.wait(list(self.running), num_returns=1)
        job = self.running.pop(reference)
        try:
            return [(job, self.ray.get(reference))]
        except self.ray.exceptions.RayTaskError as error:  # what a task raised is wrapped
            return [(job, _in_words(error.cause))]
        except self.ray.exceptions.RayError as error:
            return [(job, _in_words(error))]

    def stop(self) -> None:
        """Ends what is running, and the cluster if it was started here."""
        for reference in self.running:
            self.ray.cancel(reference, force=True)
        self.running.clear()
        if self.owned:
            self.ray.shutdown()


@contextlib.contextmanager
def _keeping_signals() -> Iterator[None]:
    """Behind the block signals mean what they did before; Ray would end the process without a word on SIGTERM."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
