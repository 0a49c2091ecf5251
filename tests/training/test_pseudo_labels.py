# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests relabelling: the window of each action, unchanged labels, no hidden action is read."""

import pytest
import torch
from toy_policies import EchoController

from torchrl_koap.data import LabelBudget, flatten_trajectories, select_state
from torchrl_koap.modules import make_koopman_inverse_dynamics
from torchrl_koap.training import pseudo_labels
from torchrl_koap.training.pseudo_labels import relabel

LENGTHS = (1, 3, 20, 7)


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
    monkeypatch.setattr(pseudo_labels, "_BATCH", batch_size)
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
