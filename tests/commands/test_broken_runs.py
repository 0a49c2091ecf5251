# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs that cannot be evaluated and disks that are full: one line, and nothing that was there is lost."""

from __future__ import annotations

import errno
import json
import os

import pytest
from command_calls import contents, fails
from tiny_runs import koap

from torchrl_koap.commands.cli import HINT
from torchrl_koap.runs import weights
from torchrl_koap.runs.weights import load_tensors, save_tensors


def edit_json(path, **entries):
    content = {**json.loads(path.read_text()), **entries}
    path.write_text(json.dumps({key: value for key, value in content.items() if value is not None}))


def edit_weights(path, *, drop="", **about):
    tensors, facts = load_tensors(path)
    kept = {name: value for name, value in tensors.items() if not (drop and drop in name)}
    assert not drop or len(kept) < len(tensors)
    save_tensors(path, kept, {**facts, **about})


BROKEN_RUNS = {
    "another task": (
        lambda run: edit_weights(run / "planner.safetensors", task="sorting"),
        "planner.safetensors was trained on task 'sorting', not on 'avoiding'",
    ),
    "no statistics of the planner": (
        lambda run: edit_weights(run / "planner.safetensors", drop="plan_normalizer"),
        '"plan_normalizer.offset"',
    ),
    "no statistics of the controller": (
        lambda run: edit_weights(run / "controller.safetensors", drop="action_normalizer"),
        "action_normalizer.offset",
    ),
    "truncated weights": (
        lambda run: os.truncate(run / "controller.safetensors", 5000),
        "controller.safetensors is damaged",
    ),
    "no weights": (lambda run: (run / "planner.safetensors").unlink(), "planner.safetensors is missing"),
    "no config": (lambda run: (run / "config.json").unlink(), "config.json is missing: is "),
    "damaged config": (lambda run: os.truncate(run / "config.json", 100), "config.json is damaged"),
    "incomplete config": (
        lambda run: edit_json(run / "config.json", planner=None),
        "config.json has no entry 'planner'",
    ),
    "unknown task": (
        lambda run: edit_json(run / "config.json", task="avoidingg"),
        "unknown task 'avoidingg'; did you mean 'avoiding'?",
    ),
    "other sizes": (
        lambda run: edit_json(
            run / "config.json",
            planner={**json.loads((run / "config.json").read_text())["planner"], "width": 16},
        ),
        "planner.safetensors was trained on planner.width 8, not on 16",
    ),
}


@pytest.mark.parametrize("kind", BROKEN_RUNS)
def test_a_run_that_cannot_be_evaluated_is_named(kind, copied_run, capsys):
    (copied_run / "eval.json").write_text("an earlier result")
    breaks, message = BROKEN_RUNS[kind]
    breaks(copied_run)
    before = contents(copied_run)
    assert message in fails(capsys, "eval", copied_run, "--episodes", 1, "--threads", 1)
    assert contents(copied_run) == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--strategy", "oracel"), "unknown strategy 'oracel'; did you mean 'oracle'?"),
        (("--replan-interval", "15"), "replan_interval must be in 1..14"),
        (("--episodes", "0"), "episodes must be >= 1, got 0"),
        (("--batch-size", "0"), "batch_size must be >= 1, got 0"),
        (("--threads", "0"), "threads must be >= 1, got 0"),
    ],
)
def test_an_evaluation_that_cannot_be_done_leaves_the_run_alone(options, message, copied_run, capsys):
    before = contents(copied_run)
    assert message in fails(capsys, "eval", copied_run, *options)
    assert contents(copied_run) == before


def test_a_missing_run_folder_is_named(tmp_path, capsys):
    line = fails(capsys, "eval", tmp_path / "nothing")
    assert f"{tmp_path / 'nothing' / 'config.json'} is missing" in line
    assert list(tmp_path.iterdir()) == []


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
