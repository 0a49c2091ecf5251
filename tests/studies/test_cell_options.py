# This source code is licensed under the MIT license found in the LICENSE file.
"""What cells are told: koap_paper as published, options for those they mean, refusals before any work."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.modules import ExecutionConfig
from torchrl_koap.studies.cell_options import (
    CellOptions,
    check_cell_options,
    evaluation_options,
    planner_options,
    training_options,
)
from torchrl_koap.studies.curve_data import thin
from torchrl_koap.studies.label_efficiency import CurveConfig, _cells, check_curve
from torchrl_koap.training.methods import get_method


def test_koap_paper_is_measured_as_published_unless_told_otherwise():
    assert training_options(CellOptions(), "koap_paper") == {}
    assert evaluation_options(CellOptions(), "koap_paper") == {"execution": ExecutionConfig()}
    assert get_method("koap_paper").execution == {"strategy": "open_loop", "blend": 0.0, "candidates": 1}
    asked = CellOptions(strategy="feedback", blend=0.8, controller_state="robot", candidates=4)
    assert training_options(asked, "koap_paper") == {"controller_state": "robot"}
    told = {"execution": ExecutionConfig("feedback", blend=0.8, candidates=4)}
    assert evaluation_options(asked, "koap_paper") == told == evaluation_options(asked, "dd")
    assert evaluation_options(asked, "dp") == {"execution": ExecutionConfig(candidates=4)}
    assert evaluation_options(CellOptions(candidates=4), "koap_paper") == {"execution": ExecutionConfig()}
    assert training_options(CellOptions(), "koap") == {}


def test_what_is_said_of_policies_reaches_those_that_have_no_planner():
    options = CellOptions(batch_size=64, policy_steps=900, policy_batch_size=16)
    assert training_options(options, "dp") == training_options(options, "vpt")
    assert training_options(options, "dp") == {"steps": 900, "batch_size": 16}
    assert training_options(options, "koap") == {"batch_size": 64} == planner_options(options)


@pytest.mark.parametrize(
    ("options", "methods", "message"),
    [
        ({"strategy": "open_loop"}, "koap,dp", "'open_loop' was asked of dp: a policy of its own executes chunks"),
        ({"strategy": "open"}, "koap", "unknown strategy 'open'"),
        ({"strategy": "open_loop", "candidates": 4}, "koap", "'open_loop' goes with 1 candidate, got 4"),
        ({"blend": 1.0}, "koap", r"blend must be in \[0, 1\), got 1.0"),
        ({"controller_state": "arm"}, "koap", "unknown part of the state 'arm'"),
        ({"planner_seeds": 0}, "koap", "planner_seeds must be >= 1, got 0"),
        ({"policy_steps": 0}, "dp", "policy_steps must be >= 1, got 0"),
        ({"policy_batch_size": -1}, "dp", "policy_batch_size must be >= 1, got -1"),
    ],
)
def test_wrong_options_are_refused(options, methods, message):
    with pytest.raises(ValueError, match=message):
        check_cell_options(CellOptions(**options), [get_method(name) for name in methods.split(",")])


def test_a_method_that_cannot_read_the_state_is_named_before_any_work(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise ValueError("include_state needs latent_dim >= state_dim")

    monkeypatch.setattr("torchrl_koap.training.trained.build_controller", refuse)
    with pytest.raises(ValueError, match="'koap' cannot read the columns 'all' of task 'sorting': include_state"):
        check_curve(CurveConfig(tmp_path / "c", task="sorting", methods="koap", controller_state="all"))
    assert not (tmp_path / "c").exists()


def test_labels_beyond_what_is_used_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"fractions must be at most data_share.* \(0.25\), got 0.5"):
        check_curve(CurveConfig(tmp_path / "c", methods="koap", fractions="0.1,0.5", data_share=0.25))


def test_fractions_of_the_first_seed_alone():
    config = CurveConfig("c", methods="koap", fractions="0.1,0.25", first_seed_only="0.25", seeds=2)
    assert [(cell.fraction, cell.seed) for cell in _cells(config)] == [(0.1, 0), (0.25, 0), (0.1, 1)]


def test_a_share_of_the_trajectories_keeps_whole_ones_and_those_with_labels():
    actions = [torch.full((4, 1), torch.nan)] * 6 + [torch.ones(4, 1)] * 2
    data = flatten_trajectories([torch.full((5, 2), float(index)) for index in range(8)], actions)
    kept = thin(data, 0.5)
    assert kept["episode"].tolist() == [number for number in range(4) for _ in range(4)]
    assert {6.0, 7.0} <= set(kept["observation"][:, 0].tolist()) and int(kept["has_action"].sum()) == 8
    assert thin(data, 1) is data
