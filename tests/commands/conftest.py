# This source code is licensed under the MIT license found in the LICENSE file.
"""Fixtures of command tests: evaluations without pictures, and recordings of a user's own robot."""

import numpy as np
import pytest
from offline_runs import record
from tiny_runs import koap


@pytest.fixture
def no_report(monkeypatch):
    monkeypatch.setattr("torchrl_koap.commands.run_commands.write_report", lambda *arguments, **options: None)


@pytest.fixture(scope="session")
def arrays(tmp_path_factory):
    """Writes six trajectories of a two-joint arm that reaches a goal; two have actions."""
    folder = tmp_path_factory.mktemp("arrays")
    for index, (states, actions) in enumerate(zip(*record(6, 30, joints=2), strict=True)):
        content = {"states": states, "state_names": ["q1", "q2", "goal1", "goal2"], "control_hz": 20.0}
        if index < 2:
            content |= {"actions": actions, "action_names": ["dq1", "dq2"]}
        np.savez(folder / f"run_{index}.npz", **content)
    return folder


@pytest.fixture(scope="session")
def arm(arrays, tmp_path_factory):
    folder = tmp_path_factory.mktemp("own") / "arm"
    assert koap("convert", arrays, "--out", folder, "--robot", "q1", "q2", "--action-units", "rad") == 0
    return folder
