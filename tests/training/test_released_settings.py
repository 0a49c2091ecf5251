# This source code is licensed under the MIT license found in the LICENSE file.
"""The first public code's unequal settings: whose updates are counted in what, and that runs obey."""

from __future__ import annotations

import json

import pytest
from tiny_runs import TINY, koap, write_demonstrations

from torchrl_koap.data import D3ILExperienceReplay, LabelBudget, WindowTable
from torchrl_koap.training.method import Phase
from torchrl_koap.training.released_settings import RELEASED, get_released


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory):
    return write_demonstrations(tmp_path_factory.mktemp("raw"), episodes=12, rows=40)


def test_updates_are_epochs_of_a_methods_own_windows(demonstrations):
    data = D3ILExperienceReplay("avoiding", demonstrations).data.clone()
    labelled, _ = LabelBudget(1).apply(data)
    table = WindowTable.build(labelled, 16)
    every, own = len(table.starts), int(table.labelled.sum())
    assert own < every and every > 256  # more than one batch, so that the counts differ
    phases = {windows: Phase("x", lambda network: None, windows) for windows in ("all", "labelled")}
    assert RELEASED["koap"].updates(phases["all"], table, 500) == 500 * -(-every // 256)
    assert RELEASED["dd"].updates(phases["labelled"], table, 500) == 500 * -(-own // 256)


@pytest.mark.parametrize(("method", "parameters"), [("koap", 1_387_524), ("dd", 266_754)])
def test_a_run_has_the_first_codes_network_and_updates(method, parameters, demonstrations, tmp_path):
    run = tmp_path / "run"
    settings = (*TINY, "--released-settings", "--epochs", 1, "--no-analysis")
    assert koap("train", "--dataset", demonstrations, "--out", run, "--method", method, *settings) == 0
    summary = json.loads((run / "summary.json").read_text())
    assert summary["controller_parameters"] == parameters
    assert summary["controller_updates"] == {"koap": 2, "dd": 1}[method]
    assert summary["decoder_fit"] == {}  # trained with the rest, not fitted afterwards
    assert summary["controller"]["learning_rate"] < RELEASED[method].learning_rate  # still in its warm-up of 200
    assert koap("eval", run, "--episodes", 1, "--no-report") == 0


def test_what_the_first_code_lacks_is_refused(demonstrations, tmp_path, capsys):
    with pytest.raises(ValueError, match="unknown method with released settings: 'linear'; known: koap"):
        get_released("linear")
    with pytest.raises(ValueError, match="did you mean 'linear'"):
        get_released("linaer")
    wrong = {
        ("--released-settings", "--decoder", "ridge"): "come with their own decoder",
        ("--epochs", "3"): "with --released-settings only",
    }
    for extra, message in wrong.items():
        assert koap("train", "--dataset", demonstrations, "--out", tmp_path / "no", *TINY, *extra) == 1
        assert message in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
