# This source code is licensed under the MIT license found in the LICENSE file.
"""Checksums of a run: a changed bit is named, a run of before has none, a call that goes on keeps them true."""

from __future__ import annotations

import shutil

import pytest
from tiny_runs import koap

from torchrl_koap.runs.run_directory import RunDirectory, RunDirectoryError
from torchrl_koap.training.digests import DIGESTS, changed_files, check_digests, forget_digests, write_digests


@pytest.fixture
def run(trained_run, tmp_path):
    shutil.copytree(trained_run, tmp_path / "run")
    return RunDirectory(tmp_path / "run")


def test_a_training_leaves_them_and_they_are_true(run):
    assert (run.path / DIGESTS).exists() and changed_files(run) == []
    check_digests(run)


@pytest.mark.parametrize("name", ["planner.safetensors", "controller.safetensors", "eigenvalues.safetensors"])
def test_a_flipped_bit_is_named(run, name):
    content = bytearray((run.path / name).read_bytes())
    content[-3] ^= 1
    (run.path / name).write_bytes(content)
    assert changed_files(run) == [name]
    with pytest.raises(RunDirectoryError, match=f"{name} changed since the training ended"):
        check_digests(run)


def test_options_with_which_a_run_may_be_resumed_do_not_count(run):
    config = run.read_json("config.json")
    run.write_json("config.json", config | {"threads": 2, "command": "koap train"})
    assert changed_files(run) == []
    run.write_json("config.json", config | {"seed": 9})
    assert changed_files(run) == ["config.json"]


def test_a_file_that_is_gone_has_changed(run):
    (run.path / "eigenvalues.safetensors").unlink()
    assert changed_files(run) == ["eigenvalues.safetensors"]


def test_a_run_of_before_is_not_judged(run):
    forget_digests(run)
    (run.path / "eigenvalues.safetensors").write_bytes(b"")
    check_digests(run)
    write_digests(run)
    assert changed_files(run) == []


def test_doctor_looks_at_every_file(run, capsys):
    assert koap("doctor", run.path) == 0
    said = capsys.readouterr().out
    assert "as the training left it" in said and "checkpoints/planner.safetensors" in said
    (run.path / "summary.json").write_text("{")
    (run.path / "eigenvalues.safetensors").write_bytes(b"")
    assert koap("doctor", run.path) == 1
    said = capsys.readouterr().err
    assert "2 problem(s)" in said and "summary.json is damaged" in said and "eigenvalues.safetensors is damaged" in said
