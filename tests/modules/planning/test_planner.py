# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the planner as a module: coordinates, modes of a bimodal future, and the tests of samplers."""

import pytest
import torch
from sampler_test_base import SamplerTestBase, walks
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_koap.modules import MLPDenoiser, StatePlanner, TemporalUnet
from torchrl_koap.modules.planning.noise_schedule import NoiseSchedule


def make_planner(**options):
    torch.manual_seed(0)
    denoiser = MLPDenoiser(2, 2 * options.get("history", 2), horizon=options.get("horizon", 14), width=16)
    return StatePlanner(denoiser, state_dim=2, **options)


class TestStatePlanner(SamplerTestBase):
    out_key, width = "plan", 2

    make = staticmethod(make_planner)

    def make_unet(self, **options):
        return StatePlanner(TemporalUnet(2, 4, channels=(16,)), state_dim=2, **options)

    def fit(self, sampler, dtype=torch.float32):
        sampler.fit_normalizers(walks(30, 2 + sampler.horizon, dtype=dtype))
        return sampler


class Bimodal(nn.Module):
    """The optimal prediction of the clean plan if it is -1 or +1 with equal chances."""

    def forward(self, x, time, condition):
        schedule = NoiseSchedule()
        signal, noise = (level[time.long()][..., None, None] for level in (schedule.signal, schedule.noise))
        return torch.tanh(signal * x / noise**2)


@pytest.mark.parametrize("relative", [True, False])
def test_statistics_are_those_of_every_step(relative):
    planner, windows = make_planner(relative=relative), walks(50)
    planner.fit_normalizers(windows)
    history, plan = planner.split_window(windows)
    encoded = planner.encode(history, plan)
    torch.testing.assert_close(planner.decode(history, encoded), plan, atol=1e-6, rtol=0)
    torch.testing.assert_close(encoded.square().mean(0).sqrt(), torch.ones(14, 2), atol=0.06, rtol=0)  # most rows move
    assert planner.encode_history(history).abs().max() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("exploration", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM])
def test_both_modes_of_a_bimodal_future_appear(exploration):
    planner = StatePlanner(Bimodal(), state_dim=1, history=1, horizon=1, relative=False, num_steps=40)
    torch.manual_seed(0)
    with set_exploration_type(exploration):
        plans = planner.sample(torch.zeros(600, 1, 1))
    torch.testing.assert_close(plans.abs(), torch.ones_like(plans), atol=0.02, rtol=0)
    assert 0.42 < (plans > 0).float().mean() < 0.58
