# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests observation models: sizes, seeds, noise, unchanged actions."""

import sys
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from regimes import REGIMES, Regime, RegimeSensor  # noqa: E402


def apply_regime(data, regime, seed=0):
    sensor = RegimeSensor(data, regime, seed=seed)
    return data.copy().set("state", sensor.noisy(sensor.recorded).to(data["state"].dtype))


def make_data(length=600, columns=2):
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(length, columns, generator=generator).cumsum(0)
    return TensorDict({"state": state, "action": state + 1, "episode": torch.arange(length) // 60}, [length])


@pytest.mark.parametrize("name", REGIMES)
def test_a_seed_fixes_a_regime_and_actions_stay(name):
    data = make_data()
    seen = apply_regime(data, REGIMES[name], seed=3)
    assert torch.equal(seen["state"], apply_regime(data, REGIMES[name], seed=3)["state"])
    assert torch.equal(seen["action"], data["action"]) and seen["state"].dtype == torch.float32
    assert seen["state"].isfinite().all()
    random = REGIMES[name].noise or REGIMES[name].distractors
    assert torch.equal(seen["state"], apply_regime(data, REGIMES[name], seed=4)["state"]) == (not random)


def test_hidden_columns_are_not_observed():
    data = make_data(columns=4)
    seen = apply_regime(data, Regime("dark", hidden=(0, 2)))["state"]
    assert torch.equal(seen, data["state"][:, [1, 3]])
    with pytest.raises(ValueError, match="hides column 4, the state has 4"):
        apply_regime(data, Regime("dark", hidden=(4,)))


class TestRegimeSensor:
    def test_other_states_are_observed_like_recorded_ones(self):
        data = make_data()
        sensor = RegimeSensor(data, REGIMES["wide_64"])
        torch.testing.assert_close(sensor.show(data["state"][40:50]), sensor.recorded[40:50])
        middle = (data["state"][3] + data["state"][4]) / 2
        assert (sensor.show(middle[None]) - sensor.recorded[3]).abs().max() > 0

    def test_noise_is_drawn_anew_and_scaled_by_the_steps_of_the_data(self):
        data = make_data(6000)
        sensor = RegimeSensor(data, REGIMES["noise"], seed=2)
        recorded, later = (sensor.noisy(sensor.recorded) - sensor.recorded for _ in range(2))
        torch.testing.assert_close(recorded, apply_regime(data, REGIMES["noise"], seed=2)["state"] - data["state"])
        assert not torch.equal(recorded, later)
        torch.testing.assert_close(later.std(0), 3 * sensor.step, rtol=0.05, atol=0)

    def test_distractors_are_shown_beside_the_state(self):
        data = make_data()
        sensor = RegimeSensor(data, REGIMES["distractors"])
        shown = sensor.show(data["state"][:5], sensor.distractors[:5])
        torch.testing.assert_close(shown, sensor.recorded[:5])
        assert not torch.allclose(sensor.show(data["state"][:5], sensor.distractors[5:10]), shown)
        with pytest.raises(ValueError, match="'distractors' shows 2 distractors beside the state"):
            sensor.show(data["state"][:5])
