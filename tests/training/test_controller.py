# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests what is checked before a controller is trained (lengths, labels, its network), and relabelling."""

from pathlib import Path

import pytest
import torch
from offline_runs import few_labels, record
from toy_policies import EchoController

from torchrl_koap import TrainConfig, fit
from torchrl_koap.data import LabelBudget, flatten_trajectories, make_demonstrations, select_state
from torchrl_koap.modules import InverseDynamics, LinearInverseDynamics, make_koopman_inverse_dynamics
from torchrl_koap.training import METHODS, Method
from torchrl_koap.training.controller import check_lengths, relabel
from torchrl_koap.training.defaults import resolve

LENGTHS = (1, 3, 20, 7)


@pytest.mark.parametrize("preset", [None, "semi_supervised"])
def test_a_short_recording_is_refused_before_the_planner_is_trained(preset, monkeypatch):
    monkeypatch.setattr("torchrl_koap.training.in_memory.learn_planner", pytest.fail)
    states, actions = record(6, joints=2)
    data, task = make_demonstrations(**few_labels(states=[states[0][:9], *states[1:]], actions=[None, *actions[1:]]))
    with pytest.raises(ValueError, match=r"1 of 6 trajectories are shorter than a window .*: 0 \(8 steps\)"):
        fit(data, task, controller={"preset": preset})


@pytest.mark.parametrize(
    ("method", "preset", "behind"),
    [("koap", None, 5), ("koap", "paper", 8), ("linear", None, 8), ("dd", None, 1), ("vae", None, 1)],
)
def test_labels_that_no_controller_can_use_are_refused_before_any_training(method, preset, behind, monkeypatch):
    monkeypatch.setattr("torchrl_koap.training.in_memory.learn_planner", pytest.fail)
    data, task = make_demonstrations(**few_labels())
    left = torch.cat([torch.arange(n - 1, -1, -1) for n in data["episode"].unique(return_counts=True)[1].tolist()])

    def fit_where(chosen, **options):
        labelled = data["has_action"] & chosen.unsqueeze(-1)
        action = torch.where(labelled, data["action"], torch.nan)
        few = data.clone().update({"has_action": labelled, "action": action})
        return fit(few, task, method=method, controller={"steps": 2, "preset": preset}, **options)

    fit_where(left == behind, planner=False)
    with pytest.raises(ValueError, match=f"no label is followed by the {behind} recorded steps that method '{method}'"):
        fit_where(left < behind)


class Failing(LinearInverseDynamics):
    def predict(self, state, frames=None):
        return {}["speed"]


class OfAllFrames(LinearInverseDynamics):
    def predict(self, state, frames=None):
        return super().predict(state)


class WithoutDecoder(LinearInverseDynamics):
    fit_labels = InverseDynamics.fit_labels


@pytest.mark.parametrize(
    ("network", "says"),
    [
        (None, "method 'odd': build gave None, wanted an InverseDynamics"),
        (
            OfAllFrames(4, 2),
            r"method 'odd': its network gave for the frames range\(.*\) \[1, 16, 2\], wanted \[1, 7, 2\]",
        ),
        (WithoutDecoder(4, 2), r"method 'odd': closed_form needs fit_labels\(\), which its controller lacks"),
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


class WindowController(EchoController):
    """The action of every frame is its whole window, so that a test sees which one was read."""

    in_key, out_key = "state", "action"

    def __init__(self, num_past=1):
        super().__init__(num_past)
        self.batches = []

    def forward(self, tensordict):
        state = tensordict["state"]
        self.batches.append(len(state))
        number = state[..., 0] + 1000 * torch.arange(state.shape[-2])  # tells the frame from the others
        action = torch.cat([state[..., 0].unsqueeze(-2).expand(-1, state.shape[-2], -1), number.unsqueeze(-1)], -1)
        return tensordict.set("action", action)


def make_data(labelled=1, act=2, dtype=torch.float32):
    """Trajectory ``i`` stands at ``100 i + t^2``, so that its velocity changes."""
    frames = [
        (100.0 * i + torch.arange(n + 1.0)[:, None] ** 2).repeat(1, 2) + torch.tensor([0.0, 0.5])
        for i, n in enumerate(LENGTHS)
    ]
    actions = [torch.randn(n, act) for n in LENGTHS]
    data = select_state(flatten_trajectories(frames, actions, dtype=dtype), (0, 1))
    return LabelBudget(count=labelled, seed=2).apply(data)[0] if labelled else data


def expected_window(data, row, window, now):
    """Written from the picture in the docstring, one frame at a time."""
    states = data["state"][data["episode"] == data["episode"][row], 0]
    over = min(3, len(states) - 1)
    velocity = (states[-1] - states[-1 - over]) / max(over, 1)
    values = []
    for frame in range(window):
        step = int(data["step_count"][row]) - now + frame
        if step >= len(states):
            values.append(float(states[-1] + (step - len(states) + 1) * velocity))
        else:
            values.append(float(states[max(step, 0)]))
    return values


@pytest.mark.parametrize("now", [0, 1, 4])
@pytest.mark.parametrize("batch_size", [3, 4096])
def test_every_unlabelled_step_gets_the_action_of_its_own_window(now, batch_size, monkeypatch):
    monkeypatch.setattr("torchrl_koap.training.controller._BATCH", batch_size)
    window = 6
    data = make_data(act=window + 1)
    controller = WindowController(now)
    result = relabel(controller, data, window=window)
    rows = (~data["has_action"].squeeze(-1)).nonzero().flatten().tolist()
    assert len(rows) == 24 and {int(data["episode"][row]) for row in rows} == {0, 1, 2}
    for row in rows:
        states = expected_window(data, row, window, now)
        torch.testing.assert_close(result["action"][row], torch.tensor([*states, states[now] + 1000 * now]))
    assert sum(controller.batches) == 24 and max(controller.batches) <= batch_size


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_labelled_steps_and_the_data_stay(dtype):
    data = make_data(dtype=dtype)
    before = data.clone()
    controller = make_koopman_inverse_dynamics(2, 2, latent_dim=8, hidden_dim=8).to(dtype)
    result = relabel(controller, data, window=16)
    kept = data["has_action"].squeeze(-1)
    assert 0 < kept.sum() < len(kept)
    assert torch.equal(result["action"][kept], data["action"][kept])
    assert result["has_action"].all() and result["has_action"].dtype == torch.bool
    assert result["action"].isfinite().all() and result["action"].dtype == dtype
    assert result["state"] is data["state"]  # a shallow copy
    assert set(data.keys(True)) == set(before.keys(True))
    for key, value in before.items(True, True):
        torch.testing.assert_close(data[key], value, rtol=0, atol=0, equal_nan=True)


def test_no_hidden_action_is_read():
    data = make_data()
    poisoned = data.clone()
    poisoned["action"][~poisoned["has_action"].squeeze(-1)] = 1e9
    torch.manual_seed(0)
    controller = make_koopman_inverse_dynamics(2, 2, latent_dim=8, hidden_dim=8)
    torch.nn.init.normal_(controller.action_decoder.linear.weight)
    clean, other = relabel(controller, data, window=16), relabel(controller, poisoned, window=16)
    assert torch.equal(clean["action"], other["action"]) and clean["action"].abs().max() < 1e6


def test_fully_labelled_and_unlabelled_data():
    controller = WindowController()
    full = make_data(labelled=0)
    result = relabel(controller, full, window=6)
    assert torch.equal(result["action"], full["action"])
    assert controller.batches == []
    nothing = full.clone()
    nothing["has_action"] = torch.zeros_like(full["has_action"])
    nothing["action"] = torch.full((31, 7), torch.nan)
    assert relabel(controller, nothing, window=6)["has_action"].all() and sum(controller.batches) == 31
