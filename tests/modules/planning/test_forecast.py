# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear forecast carries plans over to goals that were not demonstrated."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules import StatePlanner, TemporalUnet
from torchrl_koap.modules.planning.forecast import LinearForecast


def walks(count, *, frames=16, seed=0):
    """A column that goes a tenth of the way to the other one in every frame."""
    generator = torch.Generator().manual_seed(seed)
    place, goal = torch.randn(2, count, generator=generator).unbind(0)
    rows = []
    for _ in range(frames):
        rows.append(torch.stack([place, goal], -1))
        place = place + 0.1 * (goal - place)
    return torch.stack(rows, 1)


def planner(forecast, **options):
    torch.manual_seed(0)
    return StatePlanner(TemporalUnet(2, 4, channels=(8, 16)), state_dim=2, forecast=forecast, **options)


@pytest.mark.parametrize("relative", [True, False])
def test_plans_to_new_goals_before_any_training(relative):
    """What a planner adds to a forecast that fits is bounded by what the forecast left over."""
    model = planner(True, relative=relative).eval()
    model.fit_normalizers(walks(60), groups=torch.arange(60))
    new = walks(5, seed=1) * 1.5
    with torch.no_grad():
        plan = model.sample(new[:, :2])
    torch.testing.assert_close(plan, new[:, 2:], atol=2e-2, rtol=0)


def test_a_plan_comes_back_and_known_states_are_kept():
    model = planner(True)
    windows = walks(40) + 0.1 * torch.randn(40, 16, 2, generator=torch.Generator().manual_seed(3))
    model.fit_normalizers(windows, groups=torch.arange(40))
    history, plan = model.split_window(windows)
    encoded = model.encode(history, plan)
    torch.testing.assert_close(encoded.std(0, correction=0), torch.ones(14, 2), atol=1e-4, rtol=0)
    torch.testing.assert_close(model.decode(history, encoded), plan, atol=1e-5, rtol=1e-5)
    with torch.no_grad():
        again = model.sample(history[:3], prefix=plan[:3, :4])
    torch.testing.assert_close(again[:, :4], plan[:3, :4], atol=1e-5, rtol=1e-5)


def test_what_does_not_carry_over_is_not_forecast():
    """Six trajectories, each with a condition and a sequence of its own, which have nothing to do with each other."""
    generator = torch.Generator().manual_seed(0)
    condition = torch.randn(6, 1, 4, generator=generator).expand(6, 20, 4).reshape(120, 4)
    sequence = torch.randn(6, 1, 3, generator=generator).expand(6, 20, 3).reshape(120, 3)
    forecast, every_row = LinearForecast(4, 3), LinearForecast(4, 3)
    penalty = forecast.fit(condition, sequence, torch.arange(120) // 20)
    assert every_row.fit(condition, sequence) < 1 < penalty
    assert forecast.weight.norm() < 0.5 * every_row.weight.norm()


def test_two_trajectories_are_too_few_to_forecast():
    model = planner(True)
    model.fit_normalizers(walks(2).repeat_interleave(5, 0), groups=torch.arange(10) // 5)
    assert model.forecast.weight.abs().max() < 1e-4
