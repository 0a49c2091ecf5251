# This source code is licensed under the MIT license found in the LICENSE file.
"""Evaluations that cannot be done and disks that are full: one line, and nothing that was there is lost."""

import errno
import json
import os

import pytest
from command_calls import contents, fails
from tiny_runs import koap

from torchrl_koap.commands.cli import HINT
from torchrl_koap.runs import weights


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--strategy", "oracel"), "unknown strategy 'oracel'; did you mean 'oracle'?"),
        (("--replan-interval", "15"), "replan_interval must be in 1..14"),
        (("--episodes", "0"), "episodes must be >= 1, got 0"),
    ],
)
def test_an_evaluation_that_cannot_be_done_leaves_the_run_alone(options, message, copied_run, capsys):
    before = contents(copied_run)
    assert message in fails(capsys, "eval", copied_run, *options)
    assert contents(copied_run) == before


def full_disk(*arguments, **options):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("place", ["weights", "rename"])
def test_a_full_disk_damages_no_earlier_result_of_a_training(place, copied_run, monkeypatch, capsys):
    before = contents(copied_run)
    monkeypatch.setattr(*((weights, "save_file") if place == "weights" else (os, "replace")), full_disk)
    assert koap("train", "--out", copied_run, "--resume") == 1
    err = capsys.readouterr().err
    assert err.strip().splitlines()[-1].startswith("koap: ") and "No space left on device" in err
    assert "Traceback" not in err
    after = contents(copied_run)
    assert after.keys() == before.keys()
    assert [name for name in before if after[name] != before[name]] in ([], ["config.json"])
    assert json.loads(after["config.json"])["planner"]["steps"] == 20


def test_a_full_disk_damages_no_earlier_evaluation(copied_run, monkeypatch, capsys, no_report):
    assert koap("eval", copied_run, "--episodes", 1, "--threads", 1) == 0
    before = contents(copied_run)
    monkeypatch.setattr(os, "replace", full_disk)
    assert koap("eval", copied_run, "--episodes", 2, "--threads", 1) == 1
    line = capsys.readouterr().err.strip().splitlines()[-1]
    where = f"{copied_run / 'rollouts.safetensors'} could not be written: No space left on device"
    assert line == f"koap: [Errno 28] {where}; what was there before is kept ({HINT})"
    assert contents(copied_run) == before


def test_where_an_error_is_from_is_shown_on_request(monkeypatch):
    monkeypatch.setenv("KOAP_TRACEBACK", "1")
    with pytest.raises(ValueError, match="no demonstrations to learn from"):
        koap("train", "--out", "x")
