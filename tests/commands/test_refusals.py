# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests failing commands and full disks: one error line, no new files, no damage to existing ones."""

import errno
import json
import os
from pathlib import Path

import numpy as np
import pytest
from command_calls import contents, fails
from tiny_runs import TINY, koap, write_demonstrations

from torchrl_koap.commands.cli import HINT
from torchrl_koap.data import save_demonstrations
from torchrl_koap.runs import weights


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--task", "avoidin"), "unknown task 'avoidin'; did you mean 'avoiding'?"),
        (("--labels", "few"), "--labels must be a number of trajectories such as 5, or a share such as 0.02"),
        (("--labels", "9"), "9 labelled trajectories asked for, there are 8"),
        (("--labels.count", "9"), "give one of --labels, --labels.fraction, --labels.count, --labels.episodes, got"),
        (("--dataset", "nowhere"), "dataset 'nowhere' is no folder"),
        (("--planner.source", "nowhere"), "koap: nowhere is missing: wanted the folder of a finished `koap train`"),
    ],
)
def test_a_training_that_cannot_be_done_leaves_nothing_behind(options, message, demonstrations, tmp_path, capsys):
    out = tmp_path / "run"
    assert message in fails(capsys, "train", "--out", out, "--dataset", demonstrations, *TINY, *options)
    assert not out.exists()


@pytest.mark.parametrize(
    "words", [("train", "--dataset", "DATA", *TINY), ("eval", "RUN"), ("inspect", "RUN"), ("export", "RUN")]
)
def test_a_run_is_not_written_into_data(words, copied_run, demonstrations, tmp_path, capsys):
    arm = save_demonstrations(tmp_path / "arm", [np.eye(20)], control_hz=30, action_dim=2)
    (raw := tmp_path / "recordings").mkdir()
    np.savez(raw / "run_0.npz", states=np.eye(20))
    places = {"RUN": copied_run, "DATA": demonstrations}
    for folder, named in ((arm, arm / "ted"), (raw, raw)):
        before = contents(folder)
        line = fails(capsys, *(places.get(word, word) for word in words), "--out", folder)
        assert f"{named} holds data, which need a folder of their own; choose another --out" in line
        assert contents(folder) == before


@pytest.mark.parametrize("words", [("convert", "nowhere"), ("embed", "nowhere"), ("demos",)])
def test_a_data_set_is_not_written_into_a_run(words, copied_run, capsys):
    before = contents(copied_run)
    line = fails(capsys, *words, "--out", copied_run)
    assert f"{copied_run} holds a data set, recordings or a run already; choose another --out" in line
    assert contents(copied_run) == before


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="a folder that takes no files, from root neither")
@pytest.mark.parametrize("command", ["train", "convert", "eval"])
def test_a_folder_that_takes_no_files_is_named_before_any_work(command, copied_run, demonstrations, capsys):
    what = {"train": ("--dataset", demonstrations), "convert": ("nowhere",), "eval": (copied_run,)}[command]
    line = fails(capsys, command, *what, "--out", "/proc/run")
    assert "--out /proc/run cannot be written to: /proc takes no files (No such file or directory)" in line


def test_trajectories_too_short_for_a_window_are_named_before_the_planner_is_trained(tmp_path, capsys):
    data = write_demonstrations(tmp_path / "data", change=lambda i, *paths: [p[: 9 if i == 3 else None] for p in paths])
    line = fails(capsys, "train", "--out", tmp_path / "run", "--dataset", data, *TINY)
    assert "1 of 8 trajectories are shorter than a window" in line
    assert "3 (8 steps); leave them out (`koap convert --drop-short`)" in line
    assert not (tmp_path / "run").exists()


RESUME = ("train", "--out", "RUN", "--resume")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("train", "--out", "RUN", "--dataset", "DATA", *TINY), "holds a run already; choose another --out, or --res"),
        ((*RESUME, "--seed", "3"), "was started with another run.seed: it cannot be resumed"),
        ((*RESUME, "--steps", "30", "--preset", "paper"), "started with another planner.steps, controller.preset: it"),
        (("eval", "RUN", "--strategy", "oracel"), "unknown strategy 'oracel'; did you mean 'oracle'?"),
        (("eval", "RUN", "--replan-interval", "15"), "replan_interval must be in 1..14"),
        (("eval", "RUN", "--episodes", "0"), "episodes must be >= 1, got 0"),
    ],
)
def test_an_earlier_run_is_not_touched(words, message, copied_run, demonstrations, capsys):
    before, places = contents(copied_run), {"RUN": copied_run, "DATA": demonstrations}
    assert message in fails(capsys, *(places.get(word, word) for word in words))
    assert contents(copied_run) == before


@pytest.mark.parametrize("command", ["eval", "inspect"])
@pytest.mark.parametrize("wrong", [("--env", "Nowhere-v0"), ("--dataset", "nowhere")])
def test_a_wrong_call_leaves_no_copy_of_a_run(command, wrong, copied_run, tmp_path, capsys):
    fails(capsys, command, copied_run, "--out", tmp_path / "copy", *wrong)
    assert not (tmp_path / "copy").exists()


def full_disk(*arguments, **options):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("place", ["weights", "rename"])
def test_a_full_disk_damages_no_earlier_result_of_a_training(place, copied_run, monkeypatch, capsys):
    (copied_run / "summary.json").unlink()  # it is not finished
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


def test_the_traceback_of_an_error_is_shown_on_request(monkeypatch):
    monkeypatch.setenv("KOAP_TRACEBACK", "1")
    with pytest.raises(ValueError, match="no demonstrations to learn from"):
        koap("train", "--out", "x")
