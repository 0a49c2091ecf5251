# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the names of `import torchrl_koap`, and that Python and shell do the same."""

import json
import subprocess
import sys

import pytest
from tiny_runs import koap

import torchrl_koap
from torchrl_koap import (
    ControllerConfig,
    EvalConfig,
    LabelConfig,
    PlannerConfig,
    TrainConfig,
    evaluate,
    run_study,
    train,
)
from torchrl_koap.evaluation import inspect, suggest

PLAIN = {
    "labels": LabelConfig(count=2),
    "planner": PlannerConfig(steps=20, batch_size=8, width=8),
    "controller": ControllerConfig(steps=20),
}


def test_every_name_is_there():
    for name in torchrl_koap.__all__:
        assert getattr(torchrl_koap, name) is not None and name in dir(torchrl_koap)


def test_subpackages_are_attributes():
    script = "import sys, torchrl_koap; assert 'torchrl_koap.data' not in sys.modules; torchrl_koap.data.LabelBudget"
    subprocess.run([sys.executable, "-c", script], check=True)


def test_an_unknown_name_is_named():
    with pytest.raises(AttributeError, match="module 'torchrl_koap' has no attribute 'trian'"):
        torchrl_koap.trian  # noqa: B018


@pytest.mark.parametrize(
    ("call", "kind"),
    [
        (lambda given: train(given), "TrainConfig"),
        (lambda given: evaluate("runs/none", given), "EvalConfig"),
        (lambda given: inspect("runs/none", given), "InspectConfig"),
        (lambda given: suggest("runs/none", given), "SuggestConfig"),
        (lambda given: run_study(given), "Study"),
    ],
)
def test_options_of_another_kind_are_refused(call, kind):
    with pytest.raises(TypeError, match=rf"options must be {kind}\(...\), got int 3"):
        call(3)


def test_python_trains_and_evaluates_what_the_shell_does(trained_run, demonstrations, tmp_path):
    mine, its = tmp_path / "mine", tmp_path / "its"
    summary = train(TrainConfig(out=mine, dataset=str(demonstrations), **PLAIN), command="as called").results
    assert summary == json.loads((mine / "summary.json").read_text())
    for name in ("planner", "controller"):
        weights = (folder / f"{name}.safetensors" for folder in (mine, trained_run))
        assert next(weights).read_bytes() == next(weights).read_bytes()
    assert json.loads((mine / "config.json").read_text())["command"] == "as called"

    result = evaluate(mine, EvalConfig(episodes=1, threads=1))
    assert result == json.loads((mine / "eval.json").read_text()) and not (mine / "index.html").exists()
    mine.rename(its)
    assert koap("eval", its, "--episodes", 1, "--threads", 1, "--no-report") == 0
    assert json.loads((its / "eval.json").read_text())["episode"] == result["episode"]


def test_a_training_without_a_command_keeps_none(demonstrations, tmp_path):
    out = tmp_path / "run"
    train(TrainConfig(out=out, dataset=str(demonstrations), method="linear", **PLAIN))
    assert "command" not in json.loads((out / "config.json").read_text())
    assert koap("train", "--out", out, "--resume") == 0  # and a shell may go on with it
    assert "command" in json.loads((out / "config.json").read_text())
