# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests what is checked before a controller is trained: lengths, labels that can be used, and its network."""

from pathlib import Path

import pytest
import torch
from offline_runs import few_labels, record

from torchrl_koap import TrainConfig, fit
from torchrl_koap.data import make_demonstrations
from torchrl_koap.modules import LinearInverseDynamics
from torchrl_koap.training import METHODS, Method
from torchrl_koap.training.controller import check_lengths
from torchrl_koap.training.defaults import resolve


@pytest.mark.parametrize("preset", [None, "semi_supervised"])
def test_a_short_recording_is_refused_before_the_planner_is_trained(preset, monkeypatch):
    monkeypatch.setattr("torchrl_koap.training.in_memory.learn_planner", pytest.fail)
    states, actions = record(6, joints=2)
    data, task = make_demonstrations(**few_labels(states=[states[0][:9], *states[1:]], actions=[None, *actions[1:]]))
    with pytest.raises(ValueError, match=r"1 of 6 trajectories are shorter than a window .*: 0 \(8 steps\)"):
        fit(data, task, controller={"preset": preset})


@pytest.mark.parametrize(("method", "behind"), [("koap", 5), ("linear", 8), ("dd", 1), ("vae", 1)])
def test_labels_that_no_controller_can_use_are_refused_before_the_planner_is_trained(method, behind, monkeypatch):
    monkeypatch.setattr("torchrl_koap.training.in_memory.learn_planner", pytest.fail)
    data, task = make_demonstrations(**few_labels())
    left = torch.cat([torch.arange(n - 1, -1, -1) for n in data["episode"].unique(return_counts=True)[1].tolist()])

    def fit_where(chosen, **options):
        labelled = data["has_action"] & chosen.unsqueeze(-1)
        action = torch.where(labelled, data["action"], torch.nan)
        few = data.clone().update({"has_action": labelled, "action": action})
        return fit(few, task, method=method, controller={"steps": 2}, **options)

    fit_where(left == behind, planner=False)
    with pytest.raises(ValueError, match=f"no label is followed by the {behind} recorded steps that method '{method}'"):
        fit_where(left < behind)


class Failing(LinearInverseDynamics):
    def predict(self, state, frames=None):
        return {}["speed"]


@pytest.mark.parametrize(
    ("network", "says"),
    [
        (LinearInverseDynamics(4, 3), r"method 'odd': its network gave \[1, 16, 3\], wanted \[1, 16, 2\]"),
        (Failing(4, 2), r"method 'odd': its network failed on .* \[1, 16, 4\]: KeyError: 'speed'"),
    ],
)
def test_a_method_that_cannot_act_is_refused_before_the_planner_is_trained(network, says, monkeypatch):
    for module in ("in_memory", "on_disk"):
        monkeypatch.setattr(f"torchrl_koap.training.{module}.learn_planner", pytest.fail)
    monkeypatch.setitem(METHODS, "odd", Method("odd", "", lambda *_: network, closed_form=True))
    data, task = make_demonstrations(**few_labels())
    with pytest.raises(ValueError, match=says):
        fit(data, task, method="odd", controller={"columns": "all"})


@pytest.mark.parametrize("method", METHODS)
def test_checks_before_training_do_not_change_random_numbers(method):
    data, task = make_demonstrations(**few_labels())
    before = torch.get_rng_state()
    check_lengths(task, resolve(TrainConfig(out=Path(), method=method), task), data)
    assert torch.equal(torch.get_rng_state(), before)
