# This source code is licensed under the MIT license found in the LICENSE file.
"""Recorded demonstrations, and what the reader warns of."""

from __future__ import annotations

import pytest

from torchrl_koap.data.lerobot import reader as lerobot_module
from torchrl_koap.envs.experts.demonstrations import record_demonstrations


@pytest.fixture(scope="module")
def recorded():
    return record_demonstrations("avoiding", episodes=3, seed=4, num_threads=1)[0]


@pytest.fixture
def warnings(monkeypatch):
    """What the reader logs as a warning."""
    seen = []
    monkeypatch.setattr(lerobot_module.torchrl_logger, "warning", lambda text, *values: seen.append(text % values))
    return seen
