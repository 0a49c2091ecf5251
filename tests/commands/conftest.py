# This source code is licensed under the MIT license found in the LICENSE file.
"""Evaluations without pictures."""

from __future__ import annotations

import pytest


@pytest.fixture
def no_report(monkeypatch):
    """Rollouts without pictures, which have tests of their own."""
    monkeypatch.setattr("torchrl_koap.commands.run_commands.write_report", lambda *arguments, **options: None)
