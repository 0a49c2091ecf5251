# This source code is licensed under the MIT license found in the LICENSE file.
"""A single batch does not undo a training; ordinary ones are not touched; a resumed training goes on the same."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.training import loop
from torchrl_koap.training.loop import train_phase
from torchrl_koap.training.outlier_gradients import SETTLED, limit_outlier


class Regression(nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.net = nn.Sequential(nn.Linear(4, 32), nn.SiLU(), nn.Linear(32, 2))

    def forward(self, td):
        return TensorDict({"loss_fit": (self.net(td["x"]) - td["y"]).square().mean()}, [])


def batches(poison_at=None, seen=0):
    """Batches of a smooth function; one of them is a thousand times too large."""
    number = seen

    def sample():
        nonlocal number
        number += 1
        x = torch.randn(32, 4, generator=torch.Generator().manual_seed(number))
        y = torch.stack([x.sum(-1).sin(), x[:, 0] * x[:, 1]], -1)
        return TensorDict({"x": x, "y": y * (1000.0 if number == poison_at else 1.0)}, [32])

    return sample


def trained(sample, updates=600, **options):
    module = Regression()
    train_phase("planner", module, sample, num_steps=updates, learning_rate=1e-2, **options)
    return module


def error(module):
    with torch.no_grad():
        return module(batches()()).get("loss_fit").item()


def test_a_single_batch_does_not_undo_a_training(monkeypatch):
    spoiled, untouched = trained(batches(poison_at=400), 410, decay=False), trained(batches(), 410, decay=False)
    assert error(spoiled) < 1.5 * error(untouched)
    monkeypatch.setattr(loop, "limit_outlier", lambda optimizer: None)
    assert error(trained(batches(poison_at=400), 410, decay=False)) > 2 * error(untouched)


def test_ordinary_batches_leave_the_same_bits(monkeypatch):
    weights = trained(batches()).state_dict()
    monkeypatch.setattr(loop, "limit_outlier", lambda optimizer: None)
    for name, value in trained(batches()).state_dict().items():
        assert torch.equal(value, weights[name])


def test_a_resumed_training_limits_the_same(tmp_path):
    whole = trained(batches(poison_at=350), 400)

    class Stop(KeyboardInterrupt):
        pass

    def stop(done, values):
        if done == 341:
            raise Stop

    run = RunDirectory(tmp_path)
    options = {"run": run, "checkpoint_every": 170}
    with pytest.raises(Stop):
        trained(batches(poison_at=350), 400, progress=stop, **options)
    resumed = trained(batches(poison_at=350, seen=340), 400, resume=True, **options)
    for name, value in resumed.state_dict().items():
        assert torch.equal(value, whole.state_dict()[name])


def test_it_waits_until_there_is_something_to_compare_with():
    x = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.AdamW([x], lr=1e-3)
    for update in range(SETTLED):
        x.grad = torch.ones(1)
        assert limit_outlier(optimizer) is None, update
        optimizer.step()
    x.grad = torch.zeros(1)
    assert limit_outlier(optimizer).item() == 1.0
    x.grad = torch.full((1,), torch.nan)
    limit_outlier(optimizer)
    assert x.grad.isnan().all()  # the loop tells of it
