# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs that a test may change, and evaluations without pictures."""

from __future__ import annotations

import shutil

import pytest


@pytest.fixture
def copied_run(trained_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(trained_run, folder)
    return folder


@pytest.fixture
def no_report(monkeypatch):
    """Rollouts without pictures, which have tests of their own."""
    monkeypatch.setattr("torchrl_koap.commands.run_commands.write_report", lambda *arguments, **options: None)
