# This source code is licensed under the MIT license found in the LICENSE file.
"""Training states: a training goes on bit for bit, and not from what does not fit."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from torchrl_koap.modules import Normalizer
from torchrl_koap.runs.weights import CheckpointError, save_weights
from torchrl_koap.training.checkpoints import load_training_state, save_training_state


class Model(nn.Module):
    """A network with a normaliser that brings its statistics."""

    def __init__(self, *, width=4, seed=0):
        super().__init__()
        torch.manual_seed(seed)
        self.normalizer = Normalizer.fit(torch.randn(20, 3))
        self.layer = nn.Linear(3, width)

    def forward(self, x):
        return self.layer(self.normalizer(x)).square().mean()


def train_a_little(model, optimizer, steps):
    for _ in range(steps):
        model(torch.randn(6, 3)).backward()
        optimizer.step()
        optimizer.zero_grad()


def make_optimizer(model):
    return torch.optim.AdamW(model.parameters(), 1e-2, weight_decay=0.1, fused=True)


def test_a_training_goes_on_bit_for_bit(tmp_path):
    """Weights, moments, step counts, learning rate and random numbers: all of them come back."""
    model = Model()
    optimizer = make_optimizer(model)
    torch.manual_seed(5)
    train_a_little(model, optimizer, 3)
    optimizer.param_groups[0]["lr"] = 3e-3
    save_training_state(tmp_path / "state", model, optimizer, {"phase": "x", "step": 3})
    train_a_little(model, optimizer, 4)

    other = Model(seed=8)
    other_optimizer = make_optimizer(other)
    torch.manual_seed(6)
    assert load_training_state(tmp_path / "state", other, other_optimizer) == {"phase": "x", "step": 3}
    assert other_optimizer.param_groups[0]["lr"] == 3e-3
    train_a_little(other, other_optimizer, 4)
    for name, value in model.state_dict().items():
        assert torch.equal(value, other.state_dict()[name]), name
    for index, moments in optimizer.state_dict()["state"].items():
        for name, value in moments.items():
            assert torch.equal(value, other_optimizer.state_dict()["state"][index][name]), name


def test_a_state_of_another_model_or_none_at_all_is_refused(tmp_path):
    model = Model()
    save_training_state(tmp_path / "state", model, make_optimizer(model), {"step": 1})
    other = Model(width=5)
    before = {name: value.clone() for name, value in other.state_dict().items()}
    with pytest.raises(CheckpointError, match="holds the state of another model"):
        load_training_state(tmp_path / "state", other, make_optimizer(other))
    assert all(torch.equal(value, before[name]) for name, value in other.state_dict().items())
    save_weights(tmp_path / "weights", model, {"task": "avoiding"})
    with pytest.raises(CheckpointError, match="is no state of a training"):
        load_training_state(tmp_path / "weights", model, make_optimizer(model))
