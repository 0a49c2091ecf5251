# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the Diffusion Policy as a module: units, condition, hidden labels, and the tests of samplers."""

import pytest
import torch
from sampler_test_base import SamplerTestBase, walks
from torch import nn

from torchrl_koap.modules import DiffusionPolicy, MLPDenoiser, StatePlanner, TemporalUnet


class Columns(nn.Module):
    """Features that are the first column of every frame, times ten."""

    num_features = 2

    def forward(self, history):
        return 10 * history[..., 0]


def make_policy(**options):
    torch.manual_seed(0)
    features = options.get("features")
    width = 2 * options.get("history", 2) + (features.num_features if features is not None else 0)
    denoiser = MLPDenoiser(3, width, horizon=options.get("horizon", 14), width=16)
    return DiffusionPolicy(denoiser, state_dim=2, action_dim=3, **options)


def labels(number=80):
    generator = torch.Generator().manual_seed(4)
    return torch.tensor([5.0, 0.0, -2.0]) + torch.tensor([1.0, 0.1, 8.0]) * torch.randn(number, 3, generator=generator)


class TestDiffusionPolicy(SamplerTestBase):
    out_key, width = "action_chunk", 3

    make = staticmethod(make_policy)

    def make_unet(self, **options):
        return DiffusionPolicy(TemporalUnet(3, 4, channels=(16,)), state_dim=2, action_dim=3, **options)

    def fit(self, sampler, dtype=torch.float32):
        sampler.fit_normalizers(walks(30, 2 + sampler.horizon, dtype=dtype), labels().to(dtype))
        return sampler


def test_all_steps_share_their_scale():
    policy, actions = make_policy(), labels(70)
    policy.fit_normalizers(walks(50), actions)
    chunks, history = actions.reshape(5, 14, 3), walks(5)[:, :2]
    encoded = policy.encode(history, chunks)
    shuffled = chunks[:, torch.randperm(14)]
    assert torch.equal(policy.encode(history, shuffled).sort(1)[0], encoded.sort(1)[0])
    torch.testing.assert_close(policy.action_normalizer.scale, (actions.amax(0) - actions.amin(0)) / 2)
    assert policy.encode_history(walks(50)[:, :2]).abs().max() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("features", [None, Columns()])
def test_the_condition_is_the_planners(relative, features):
    policy = make_policy(relative=relative, features=features)
    planner = StatePlanner(nn.Identity(), state_dim=2, relative=relative, features=features)
    windows = walks(40)
    history = windows[:4, :2]
    raw = policy.encode_history(history)
    before = history[:, 0] - history[:, 1] if relative else history[:, 0]
    torch.testing.assert_close(raw[:, :4], torch.cat([before, history[:, 1]], -1))
    if features is not None:
        torch.testing.assert_close(raw[:, 4:], 10 * history[..., 0])
    policy.fit_normalizers(windows, labels())
    planner.fit_normalizers(windows)
    torch.testing.assert_close(policy.encode_history(history), planner.encode_history(history))
    assert make_policy().relative is False


def test_wrong_actions_and_hidden_labels_are_explained():
    policy = make_policy(num_steps=3)
    with pytest.raises(ValueError, match=r"actions must be \[\*M, 3\] \(action_dim\), got \[9, 2\]"):
        policy.fit_normalizers(walks(4), torch.zeros(9, 2))
    before = policy.state_dict()["condition_normalizer.scale"].clone()
    hidden = labels()
    hidden[3] = torch.nan
    with pytest.raises(ValueError, match="1 of 80 rows are NaN"):
        policy.fit_normalizers(walks(4), hidden)
    assert torch.equal(policy.condition_normalizer.scale, before)  # a failed call changes nothing
    with pytest.raises(ValueError, match="width must be at least 1"):
        DiffusionPolicy(nn.Identity(), state_dim=2, action_dim=0)
