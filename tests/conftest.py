# This source code is licensed under the MIT license found in the LICENSE file.
"""One thread per test process, and tiny demonstrations and runs shared by all tests."""

import multiprocessing
import shutil
from multiprocessing import forkserver

import pytest
import torch
from tiny_runs import TINY, koap, write_demonstrations

# two processes with two threads each on two cores wait for each other most of the time
torch.set_num_threads(1)


@pytest.fixture(scope="session")
def job_server():
    """The server whose copies do the jobs of tests has imported what they need, whichever test starts it."""
    rooms = ("studies.launchers", "studies.cells", "evaluation.closed_loop", "envs.avoiding")
    forkserver.set_forkserver_preload(["torchrl.collectors", *(f"torchrl_koap.{room}" for room in rooms)])
    process = multiprocessing.get_context("forkserver").Process(target=len, args=("",))
    process.start(), process.join()  # now it is there


@pytest.fixture
def copied_processes(job_server):
    """TorchRL's processes are copies of that server; what they are handed is pickled as for spawned ones."""
    before = torch.multiprocessing.get_start_method(allow_none=True)
    torch.multiprocessing.set_start_method("forkserver", force=True)
    yield
    torch.multiprocessing.set_start_method(before, force=True)


@pytest.fixture(scope="session")
def demonstrations(tmp_path_factory):
    return write_demonstrations(tmp_path_factory.mktemp("demonstrations"))


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory, demonstrations):
    """A run directory of `koap train`; not to be written to."""
    folder = tmp_path_factory.mktemp("runs") / "trained"
    assert koap("train", "--out", folder, "--dataset", demonstrations, *TINY) == 0
    return folder


@pytest.fixture
def copied_run(trained_run, tmp_path):
    """The same, for a test that writes to it."""
    return shutil.copytree(trained_run, tmp_path / "run")
