# This source code is licensed under the MIT license found in the LICENSE file.
"""Evaluations without pictures, and recordings of a robot of one's own."""

from __future__ import annotations

import numpy as np
import pytest
from tiny_runs import koap


@pytest.fixture
def no_report(monkeypatch):
    """Rollouts without pictures, which have tests of their own."""
    monkeypatch.setattr("torchrl_koap.commands.run_commands.write_report", lambda *arguments, **options: None)


@pytest.fixture(scope="session")
def arrays(tmp_path_factory):
    """Six trajectories of a two-joint arm that reaches for a goal; two have actions."""
    folder, generator = tmp_path_factory.mktemp("arrays"), np.random.default_rng(0)
    for index in range(6):
        joints, goal, velocity = generator.uniform(-1, 1, 2), generator.uniform(-1, 1, 2), np.zeros(2)
        frames, steps = [], []
        for _ in range(30):
            frames.append(np.r_[joints, goal])
            steps.append(0.2 * (goal - joints))
            velocity = 0.5 * velocity + 0.5 * steps[-1]
            joints = joints + velocity
        content = {"states": np.array(frames), "state_names": ["q1", "q2", "goal1", "goal2"], "control_hz": 20.0}
        if index < 2:
            content |= {"actions": np.array(steps), "action_names": ["dq1", "dq2"]}
        np.savez(folder / f"run_{index}.npz", **content)
    return folder


@pytest.fixture(scope="session")
def arm(arrays, tmp_path_factory):
    """The data set that they are converted to."""
    folder = tmp_path_factory.mktemp("own") / "arm"
    assert koap("convert", arrays, "--out", folder, "--robot", "q1", "q2", "--action-units", "rad") == 0
    return folder
