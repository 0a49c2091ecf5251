# This source code is licensed under the MIT license found in the LICENSE file.
"""Many independent jobs, in processes of this machine or on a Ray cluster. One that dies takes no other along."""

from __future__ import annotations

import contextlib
import graphlib
import importlib.util
import multiprocessing
import os
import secrets
import signal
import tempfile
import threading
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import connection, forkserver
from pathlib import Path
from typing import Any, TextIO

from torchrl_koap.lookup import lookup

_LONGEST = 500  # characters of a reason


@dataclass(frozen=True)
class Job:
    """A call that can be sent elsewhere.

    Args:
        name (str): unique name.
        function (callable): a module-level function; what it has to say it writes to files.
        arguments (dict): its keyword arguments, plain values.
        log (Path): file that what it prints is appended to.
        needs (tuple of str): names of the jobs that must have succeeded before.

    Examples:
        >>> import time
        >>> from torchrl_koap.studies.launchers import Job
        >>> Job("after", time.sleep, {"secs": 0}, needs=("before",)).needs
        ('before',)
    """

    name: str
    function: Callable[..., None]
    arguments: dict[str, Any] = field(default_factory=dict)
    log: Path = Path(os.devnull)
    needs: tuple[str, ...] = ()


def launch(
    jobs: Sequence[Job],
    *,
    launcher: str = "local",
    workers: int = 2,
    address: str | None = None,
    preload: Sequence[str] = (),
) -> Generator[tuple[Job, str | None], None, None]:
    """Runs jobs, each in a process of its own, and yields them as they end with the reason if they failed.

    A job whose need failed is not run and fails too. Closing the iterator stops what is running.

    Args:
        jobs (sequence of Job): what to do; those that come first are started first.

    Keyword Args:
        launcher (str): ``"local"`` or ``"ray"`` (extra ``ray``; the folders must be visible to all machines).
        workers (int): jobs at a time; on a cluster what Ray's own resources allow, one CPU each.
        address (str, optional): of a Ray cluster. Default: one on this machine with that many workers.
        preload (sequence of str): modules to import once on this machine; a job's process starts as a copy of that.

    Raises:
        ValueError: for an unknown launcher, no workers, two jobs of one name, a need that is no job, jobs that wait for
            each other, or a launcher that is not installed.
    """
    check_launcher(launcher, workers=workers, address=address)
    needs = {job.name: job.needs for job in jobs}
    if len(needs) < len(jobs):
        names = [job.name for job in jobs]
        raise ValueError(f"jobs need names of their own; twice: {sorted({n for n in names if names.count(n) > 1})}")
    for name in needs:
        absent = [need for need in needs[name] if need not in needs]
        if absent:
            raise ValueError(f"job {name!r} needs {absent}, which are no jobs")
    try:
        graphlib.TopologicalSorter(needs).prepare()
    except graphlib.CycleError as error:
        raise ValueError(f"jobs wait for each other: {' -> '.join(error.args[1])}") from None
    return _schedule(list(jobs), LAUNCHERS[launcher](workers, address, preload))


def check_launcher(launcher: str, *, workers: int = 1, address: str | None = None) -> None:
    """Refuses before any work what :func:`launch` could not do.

    Args:
        launcher (str): name of the launcher.

    Keyword Args:
        workers (int): jobs at a time.
        address (str, optional): of a Ray cluster.

    Raises:
        ValueError: for an unknown launcher, one that is not installed, no workers, or an address that is of no use.
    """
    lookup(LAUNCHERS, launcher, "launcher")
    if workers < 1:
        raise ValueError(f"workers must be >= 1, got {workers}")
    if launcher == "local" and address is not None:
        raise ValueError("an address was given, but launcher 'local' works on this machine alone")
    if launcher == "ray" and importlib.util.find_spec("ray") is None:
        raise ValueError("launcher 'ray' needs an extra: pip install 'torchrl_koap[ray]'")


def _schedule(waiting: list[Job], pool: Any) -> Generator[tuple[Job, str | None], None, None]:
    succeeded: set[str] = set()
    failed: dict[str, str] = {}
    running = 0
    try:
        while waiting or running:
            doomed = [job for job in waiting if any(need in failed for need in job.needs)]
            for job in doomed:
                waiting.remove(job)
                need = next(need for need in job.needs if need in failed)
                failed[job.name] = f"{need} failed: {failed[need]}"
                yield job, failed[job.name]
            ready = [job for job in waiting if succeeded.issuperset(job.needs)]
            for job in ready[: pool.free]:
                waiting.remove(job)
                pool.start(job)
                running += 1
            if not running:
                continue
            for job, reason in pool.finished():
                running -= 1
                if reason is None:
                    succeeded.add(job.name)
                else:
                    failed[job.name] = reason
                yield job, reason
    finally:
        pool.stop()


def run_logged(job_log: str, function: Callable[..., None], arguments: dict[str, Any]) -> str | None:
    """Calls a function with everything it prints going to a file.

    Args:
        job_log (str): file to append to.
        function (callable): what to call.
        arguments (dict): its keyword arguments.

    Returns:
        str or None: why it failed, None if it did not.
    """
    try:
        with _open_log(job_log) as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                function(**arguments)
            except Exception:
                traceback.print_exc(file=file)
                raise
    except Exception as error:  # also where there is no place for a log
        return _in_words(error)
    return None


def _open_log(path: str) -> TextIO:
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    return Path(path).open("a", buffering=1)  # by lines: a job that is killed has said what it did until then


def _in_words(error: Exception) -> str:
    """Type and first line; cut, as a pipe holds 64 KB and nobody reads it before the process has ended."""
    lines = str(error).strip().splitlines() or [""]
    return f"{type(error).__name__}: {lines[0][:_LONGEST]}".removesuffix(": ")


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """What is started inside never sees Ctrl-C, which is this process's to handle, not even while it starts."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


class _LocalPool:
    """Processes that are copies of a server which has imported everything: a job starts in a fraction of a second."""

    def __init__(self, workers: int, address: str | None, preload: Sequence[str] = ()):
        self.workers = workers
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["torchrl_koap.studies.end_with_parent", *preload])
        with _without_ctrl_c():
            forkserver.ensure_running()
        self.running: dict[Any, tuple[Job, Any, Any]] = {}

    @property
    def free(self) -> int:
        return self.workers - len(self.running)

    def start(self, job: Job) -> None:
        reader, writer = self.context.Pipe(duplex=False)
        process = self.context.Process(target=_child, args=(writer, str(job.log), job.function, job.arguments))
        process.start()
        writer.close()
        self.running[process.sentinel] = (job, process, reader)

    def finished(self) -> list[tuple[Job, str | None]]:
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
        for _, process, _ in self.running.values():
            process.kill()
        for _, process, _ in self.running.values():
            process.join()
        self.running.clear()


def _death(exit_code: int) -> str:
    if exit_code == -signal.SIGKILL:
        return "killed by the system (signal 9): probably out of memory; try fewer --workers"
    what = f"exit code {exit_code}" if exit_code >= 0 else f"signal {-exit_code}, {signal.strsignal(-exit_code)}"
    return f"its process ended without a word ({what})"


def _child(writer: Any, log: str, function: Callable[..., None], arguments: dict[str, Any]) -> None:
    # not to outlive a killed parent: the next `koap curve` in the folder would meet its own ghost
    threading.Thread(target=_die_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    with contextlib.suppress(OSError), _open_log(log) as file:  # what is not Python prints past sys.stdout
        for descriptor in (1, 2):
            os.dup2(file.fileno(), descriptor)
    writer.send(run_logged(log, function, arguments))
    writer.close()


def _die_with_parent() -> None:
    multiprocessing.parent_process().join()
    os.kill(os.getpid(), signal.SIGKILL)


class _RayPool:
    """Tasks of a Ray cluster; a task that dies is not tried again."""

    def __init__(self, workers: int, address: str | None, preload: Sequence[str] = ()):
        import ray

        self.ray = ray
        self.owned = not ray.is_initialized()
        self.left = contextlib.ExitStack()
        if self.owned:
            if address is None:
                self.left.enter_context(_own_token())
            # "local", as None means a cluster that happens to run already, which takes no sizes
            size = {} if address is not None else {"num_cpus": workers, "include_dashboard": False}
            with _keeping_signals():
                ray.init(address=address or "local", log_to_driver=False, **size)
        self.workers = max(int(ray.cluster_resources().get("CPU", workers)), 1)
        self.task = ray.remote(num_cpus=1, max_retries=0)(run_logged)
        self.running: dict[Any, Job] = {}

    @property
    def free(self) -> int:
        return self.workers - len(self.running)

    def start(self, job: Job) -> None:
        self.running[self.task.remote(str(Path(job.log).absolute()), job.function, job.arguments)] = job

    def finished(self) -> list[tuple[Job, str | None]]:
        (reference,), _ = self.ray.wait(list(self.running), num_returns=1)
        job = self.running.pop(reference)
        try:
            return [(job, self.ray.get(reference))]
        except self.ray.exceptions.RayError as error:
            # what a task raised is wrapped, with its traceback as the message
            return [(job, _in_words(getattr(error, "cause", None) or error))]

    def stop(self) -> None:
        for reference in self.running:
            self.ray.cancel(reference, force=True)
        self.running.clear()
        if self.owned:
            self.ray.shutdown()
            self.left.close()


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


@contextlib.contextmanager
def _own_token() -> Iterator[None]:
    """Inside the block Ray has a token for its own use; it would write one into the home folder and leave it there."""
    if any(name.startswith("RAY_AUTH") for name in os.environ) or (Path.home() / ".ray" / "auth_token").exists():
        yield
        return
    with tempfile.TemporaryDirectory(prefix="koap-ray-") as folder:
        token = Path(folder) / "token"
        token.write_text(secrets.token_hex(32))
        token.chmod(0o600)
        os.environ["RAY_AUTH_TOKEN_PATH"] = str(token)
        try:
            yield
        finally:
            os.environ.pop("RAY_AUTH_TOKEN_PATH", None)


LAUNCHERS = {"local": _LocalPool, "ray": _RayPool}
