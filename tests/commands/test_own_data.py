# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the commands from a folder of arrays with few labels to a trained, exported policy."""

import json
import re
import shlex

import numpy as np
import pytest
from tiny_runs import koap

from torchrl_koap.data.ted import load_ted
from torchrl_koap.evaluation import load_policy
from torchrl_koap.modules import Agent

TINY = ("--steps", 20, "--planner.batch-size", 8, "--planner.width", 8, "--controller.steps", 20)


@pytest.fixture(scope="module")
def run(arm):
    out = arm.parent / "run"
    assert koap("train", "--dataset", arm, "--out", out, *TINY, "--planner.network", "mlp") == 0
    return out


def test_an_evaluation_ends_with_its_report(run, capsys):
    assert koap("eval", run) == 0
    assert capsys.readouterr().out.splitlines()[-1].split() == ["report", str(run / "index.html")]


def test_the_next_call_works_with_a_blank_in_the_name(arrays, tmp_path, capsys):
    assert koap("convert", arrays, "--out", tmp_path / "arm", "--name", "my arm") == 0
    call = shlex.split(capsys.readouterr().out.splitlines()[-1])
    assert call == ["next", "koap", "train", "--dataset", str(tmp_path / "arm"), "--out", "runs/my arm"]


def test_absolute_targets(arrays, tmp_path, capsys):
    (tmp_path / "arrays").mkdir()
    for file in arrays.iterdir():
        content = dict(np.load(file))
        if "actions" in content:
            content["actions"] = content["states"][:, :2] + content["actions"]
        np.savez(tmp_path / "arrays" / file.name, **content)
    command = ("convert", tmp_path / "arrays", "--out", tmp_path / "arm", "--name", "reach", "--robot", "q1", "q2")
    assert koap(*command, "--out", tmp_path / "wrong") == 0
    assert koap("validate", tmp_path / "wrong") == 0
    printed = capsys.readouterr().out
    assert re.search("^action kind +delta .default.$", printed, re.MULTILINE)
    assert re.search("^labels look +absolute: .+ .near a column; mean correlation 1", printed, re.MULTILINE)
    assert printed.count("look like absolute targets; convert again with --action-kind absolute\n") == 2
    assert koap(*command, "--action-kind", "absolute") == 0
    assert "absolute targets" not in capsys.readouterr().out
    assert koap("train", "--dataset", tmp_path / "arm", "--out", tmp_path / "run", "--method", "linear", *TINY) == 0
    assert capsys.readouterr().out.splitlines()[-1].split(maxsplit=1) == ["next", f"koap eval {tmp_path / 'run'}"]
    data, _ = load_ted(tmp_path / "arm" / "ted")
    agent = Agent(load_policy(tmp_path / "run", limits=float("inf")))
    agent.reset()
    far = data["observation"][0].numpy() + np.array([5.0, 5.0, 5.0, 5.0])
    near = agent.act(data["observation"][0].numpy())
    agent.reset()
    moved = agent.act(far)
    # what is learnt is the distance to the target: a robot that starts elsewhere is sent elsewhere
    assert np.abs(moved - near).min() > 2


def test_export_and_latency(run, tmp_path, capsys):
    assert koap("export", run, "--out", tmp_path / "exported") == 0
    assert {file.name for file in (tmp_path / "exported").iterdir()} == {"policy.pt2", "policy.json"}
    printed = capsys.readouterr().out
    assert "open loop between plans" in printed
    facts = json.loads((tmp_path / "exported" / "policy.json").read_text())
    observed, acted = facts["inputs"]["observations"], facts["outputs"]["actions"]
    assert (observed["columns"], acted["columns"]) == (["q1", "q2", "goal1", "goal2"], ["dq1", "dq2"])
    assert acted["units"] == ["rad", "rad"] and facts["control_hz"] == 20
    assert acted["kinds"] == ["delta", "delta"]  # without it a target cannot be told from a change
    assert koap("latency", run, "--steps", 10) == 0
    late, times = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"late steps +\d+ of 10; a step may take 50 ms", late)
    assert re.fullmatch(r"time per step +median \S+ ms, 99 % below \S+ ms, longest \S+ ms", times)
    assert koap("latency", run, "--steps", 10, "--async-replan") == 0
