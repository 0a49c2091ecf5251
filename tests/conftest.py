# This source code is licensed under the MIT license found in the LICENSE file.
"""Sets one thread per test process; provides tiny demonstrations and runs for all tests."""

import multiprocessing
import shutil
from multiprocessing import forkserver

import pytest
import torch
from tiny_runs import TINY, koap, write_demonstrations

# two processes with two threads each on two cores would mostly wait for each other
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def job_server():
    """Starts the fork server of the tests' jobs after it has imported the packages that jobs need."""
    rooms = ("studies.launchers", "studies.cells", "evaluation.closed_loop", "envs.avoiding")
    forkserver.set_forkserver_preload(["torchrl.collectors", *(f"torchrl_koap.{room}" for room in rooms)])
    process = multiprocessing.get_context("forkserver").Process(target=len, args=("",))
    process.start(), process.join()  # the first process starts the server


@pytest.fixture
def copied_processes(job_server):
    """Makes TorchRL fork its processes from that server; their arguments are pickled as for spawned processes."""
    before = torch.multiprocessing.get_start_method(allow_none=True)
    torch.multiprocessing.set_start_method("forkserver", force=True)
    yield
    torch.multiprocessing.set_start_method(before, force=True)


@pytest.fixture(scope="session")
def demonstrations(tmp_path_factory):
    return write_demonstrations(tmp_path_factory.mktemp("demonstrations"))


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory, demonstrations):
    """Returns a run directory of `koap train`; tests must not write to it."""
    folder = tmp_path_factory.mktemp("runs") / "trained"
    assert koap("train", "--out", folder, "--dataset", demonstrations, *TINY) == 0
    return folder


@pytest.fixture
def copied_run(trained_run, tmp_path):
    """Returns a copy of that run for tests that write to it."""
    return shutil.copytree(trained_run, tmp_path / "run")
