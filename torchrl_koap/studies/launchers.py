# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs many independent jobs, in processes of this machine or on a Ray cluster; one that fails stops no other."""

from __future__ import annotations

import contextlib
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

_LONGEST = 500  # characters of a reason at most
_PATIENCE = 3  # seconds in which a process may release system resources, such as semaphores


@dataclass(frozen=True)
class Job:
    """A folder that describes the work to do; printed output is appended to its ``log.txt``."""

    folder: Path
    needs: Path | None = None  # folder of the job that must succeed first


@dataclass(frozen=True)
class Machines:
    """Where the cells of a study run.

    Attributes:
        workers: cells at a time (default: one per core; a cluster given by its address decides for itself).
        launcher: "local" or "ray" (extra `ray`; the folders must be visible to all machines).
        address: address of a Ray cluster (default: a new one on this machine).

    Raises:
        ValueError: for an unknown launcher, no workers, or an address that launcher "local" does not use; for a
            launcher that is not installed, naming its extra.
    """

    workers: int | None = None
    launcher: str = "local"
    address: str | None = None

    def __post_init__(self):
        lookup(("local", "ray"), self.launcher, "launcher")
        if self.workers is not None and self.workers < 1:
            raise ValueError(f"workers must be >= 1, got {self.workers}")
        if self.launcher == "local" and self.address is not None:
            raise ValueError("an address was given, but launcher 'local' uses only this machine")
        if self.launcher == "ray" and importlib.util.find_spec("ray") is None:
            raise ValueError("launcher 'ray' needs an extra: pip install 'torchrl_koap[ray]'")


def launch(
    function: Callable[[str], None], jobs: Sequence[Job], machines: Machines
) -> Generator[tuple[Job, str | None], None, None]:
    """Calls a function with every job's folder, in a process each; yields jobs as they end, with reasons of failures.

    Processes import the function, so it must be at the top level of a module. Jobs start in the given order. A job that
    needs a failed one is not run and fails too. Closing the iterator stops running jobs.
    """
    # on a cluster, this process may be restricted to some cores of its machine
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
    """Calls a function with a folder and logs everything it prints; returns why it failed, or None."""
    try:
        with _open_log(folder) as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                function(folder)
            except Exception:
                traceback.print_exc(file=file)
                raise
    except Exception as error:  # also if the log cannot be opened
        return _in_words(error)
    return None


def _open_log(folder: str) -> TextIO:
    Path(folder).mkdir(parents=True, exist_ok=True)
    return Path(folder, "log.txt").open("a", buffering=1)  # line by line, so that a killed job leaves its output


def _in_words(error: Exception) -> str:
    """Returns type and first line, cut: a pipe holds 64 KB, and is read only after the process has ended."""
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0][:_LONGEST]}".removesuffix(": ")


class LocalPool:
    """Processes forked from a server that has imported everything: a job starts in a fraction of a second."""

    def __init__(self, function: Callable[[str], None], workers: int):
        self.function, self.workers = function, workers
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["torchrl_koap.studies.launchers", function.__module__])
        earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})  # only this process handles Ctrl-C
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
            except (EOFError, OSError):  # poll() is also true for a closed pipe
                reason = _death(process.exitcode)
            reader.close()
            ended.append((job, reason))
        return ended

    def stop(self) -> None:
        """Terminates running jobs, and kills those that do not end in time."""
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
    return f"its process ended without an error message ({what})"


def _child(writer: Any, function: Callable[[str], None], folder: str) -> None:
    # must end with a killed parent: else it would still write when the next `koap curve` starts in the folder
    threading.Thread(target=_die_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # only the parent handles Ctrl-C
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    with contextlib.suppress(OSError), _open_log(folder) as file:  # C libraries do not print to sys.stdout
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
    writer.send(run_logged(function, folder))
    writer.close()


def _die_with_parent() -> None:
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGKILL)


class RayPool:
    """Tasks of a Ray cluster; a task that dies is not retried.

    A running cluster, given by its address, decides by itself how many tasks run at a time.
    """

    def __init__(self, function: Callable[[str], None], workers: int, address: str | None):
        import ray  # the extra

        self.ray, self.function = ray, function
        self.owned = not ray.is_initialized()
        if self.owned:
            # not None, which would connect to a running cluster, whose size cannot be set
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
        except self.ray.exceptions.RayTaskError as error:  # wraps the error of the task
            return [(job, _in_words(error.cause))]
        except self.ray.exceptions.RayError as error:
            return [(job, _in_words(error))]

    def stop(self) -> None:
        """Cancels running jobs, and stops the cluster if it was started here."""
        for reference in self.running:
            self.ray.cancel(reference, force=True)
        self.running.clear()
        if self.owned:
            self.ray.shutdown()


@contextlib.contextmanager
def _keeping_signals() -> Iterator[None]:
    """Restores signal handlers after the block: Ray's handler of SIGTERM would end the process without a message."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    earlier = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in earlier.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
