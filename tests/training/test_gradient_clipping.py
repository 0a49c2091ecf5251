# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that gradients far longer than earlier ones are shortened."""

import math

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_koap.training import loop as loop_file
from torchrl_koap.training.loop import SETTLED, AdaptiveClipping, train_phase


class Regression(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.net = nn.Sequential(nn.Linear(4, 32), nn.SiLU(), nn.Linear(32, 2))

    def forward(self, td):
        return TensorDict({"loss_fit": (self.net(td["x"]) - td["y"]).square().mean()}, [])


def batches(poison_at=None):
    """Batches of a smooth function; one of them is a thousand times too large."""
    number = 0

    def sample():
        nonlocal number
        number += 1
        x = torch.randn(32, 4, generator=torch.Generator().manual_seed(number))
        y = torch.stack([x.sum(-1).sin(), x[:, 0] * x[:, 1]], -1)
        return TensorDict({"x": x, "y": y * (1000.0 if number == poison_at else 1.0)}, [32])

    return sample


def trained(sample, updates=200, **options):
    module = Regression()
    train_phase("planner", module, sample, num_steps=updates, learning_rate=1e-2, **options)
    return module


def error(module):
    with torch.no_grad():
        return module(batches()()).get("loss_fit").item()


def test_a_single_batch_does_not_undo_a_training(monkeypatch):
    monkeypatch.setattr(loop_file, "warmup_cosine", lambda step, num_steps, warmup: min(1.0, (step + 1) / warmup))
    spoiled, untouched = trained(batches(poison_at=150), 160), trained(batches(), 160)
    assert error(spoiled) < 1.5 * error(untouched)
    monkeypatch.setattr(loop_file, "TIMES", math.inf)
    assert error(trained(batches(poison_at=150), 160)) > 2 * error(untouched)


def test_a_gradient_far_longer_than_those_before_is_shortened():
    x = nn.Parameter(torch.zeros(1, dtype=torch.float64))
    limit = AdaptiveClipping([x], decay=0.9)
    for update in range(SETTLED):
        x.grad = torch.full_like(x, 30.0 if update == 0 else -3.0)
        assert limit().item() == 1.0, update
    x.grad = torch.full_like(x, 60.0)
    assert limit().item() == pytest.approx(15 / 60, rel=1e-3)
    assert x.grad.item() == pytest.approx(15.0, rel=1e-3)
    assert limit.mean_square.item() == pytest.approx(0.9 * 9 + 0.1 * 15**2, rel=1e-3)
    x.grad = torch.zeros(1, dtype=torch.float64)
    assert limit().item() == 1.0
    x.grad = torch.full_like(x, torch.nan)
    limit()
    assert x.grad.isnan().all()  # the loop tells of it


def test_a_hundred_gradients_tell_the_usual_length():
    x = nn.Parameter(torch.zeros(1))
    for usual, wanted in ((3.0, 0.25), (0.0, 1.0)):
        limit = AdaptiveClipping([x], decay=0.999)
        for length in [usual] * SETTLED + [20 * usual]:
            x.grad = torch.full_like(x, length)
            factor = limit().item()
        assert factor == pytest.approx(wanted)


def test_a_training_whose_first_gradients_are_zero_begins_later():
    x = nn.Parameter(torch.zeros(1))
    limit = AdaptiveClipping([x], decay=0.999)
    for length in [0.0] * (SETTLED + 1) + [3.0]:
        x.grad = torch.full_like(x, length)
        factor = limit().item()
    assert factor == 1.0 and x.grad.item() == 3.0


def test_a_gradient_too_long_for_its_type_does_not_end_the_clipping():
    """Its entries are finite, the sum of their squares is not."""
    x = nn.Parameter(torch.zeros(2))
    limit = AdaptiveClipping([x], decay=0.999)
    for length in [3.0] * SETTLED + [1e25, 60.0]:
        x.grad = torch.full_like(x, length)
        factor = limit().item()
    assert factor == pytest.approx(0.25, rel=0.01)
