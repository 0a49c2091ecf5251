# This source code is licensed under the MIT license found in the LICENSE file.
"""Jobs as tasks of a Ray cluster (extra ``ray``, imported with the first pool)."""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from torchrl_koap.studies.launchers import Job, in_words, run_logged


class RayPool:
    """Tasks of a Ray cluster; a task that dies is not tried again.

    Args:
        function (callable): what jobs do.
        workers (int): jobs at a time, on a cluster of its own.
        address (str, optional): of a cluster that runs, which decides how many by itself.
    """

    def __init__(self, function: Callable[[str], None], workers: int, address: str | None):
        import ray

        self.ray, self.function = ray, function
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
        """How many jobs may be started now."""
        return self.workers - len(self.running)

    def start(self, job: Job) -> None:
        """Starts a job."""
        folder, log = str(job.folder.absolute()), str(job.log.absolute())
        self.running[self.task.remote(self.function, folder, log)] = job

    def finished(self) -> list[tuple[Job, str | None]]:
        """Waits for a job to end; returns it with the reason if it failed."""
        (reference,), _ = self.ray.wait(list(self.running), num_returns=1)
        job = self.running.pop(reference)
        try:
            return [(job, self.ray.get(reference))]
        except self.ray.exceptions.RayError as error:
            # what a task raised is wrapped, with its traceback as the message
            return [(job, in_words(getattr(error, "cause", None) or error))]

    def stop(self) -> None:
        """Ends what is running, and the cluster if it was started here."""
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
