# This source code is licensed under the MIT license found in the LICENSE file.
"""Regimes of observation: sizes, seeds, noise, what stays as it was."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.data.regimes import REGIMES, Regime, apply_regime


def make_data(length=600, columns=2):
    generator = torch.Generator().manual_seed(0)
    state = torch.randn(length, columns, generator=generator).cumsum(0)
    return TensorDict({"state": state, "action": state + 1, "episode": torch.arange(length) // 60}, [length])


@pytest.mark.parametrize("name", REGIMES)
def test_a_seed_fixes_a_regime_and_actions_stay(name):
    data = make_data()
    seen = apply_regime(data, name, seed=3)
    assert torch.equal(seen["state"], apply_regime(data, name, seed=3)["state"])
    assert torch.equal(seen["action"], data["action"]) and seen["state"].dtype == torch.float32
    assert seen["state"].isfinite().all()
    random = REGIMES[name].noise or REGIMES[name].distractors
    assert torch.equal(seen["state"], apply_regime(data, name, seed=4)["state"]) == (not random)


def test_sizes():
    shapes = {name: apply_regime(make_data(120), name)["state"].shape[-1] for name in REGIMES}
    assert shapes["plain"] == shapes["noise"] == 2
    assert shapes["wide_64"] == shapes["pictures"] == shapes["distractors"] == 64 and shapes["wide_512"] == 512


def test_noise_is_in_steps_of_each_column():
    data = make_data(6000)
    data["state"] *= torch.tensor([1.0, 10.0])
    error = (apply_regime(data, Regime("loud", "", noise=2.0))["state"] - data["state"]).std(0)
    assert error.tolist() == pytest.approx([2.0, 20.0], rel=0.06)


def test_hidden_columns_are_gone():
    data = make_data(columns=4)
    seen = apply_regime(data, Regime("dark", "", hidden=(0, 2)))["state"]
    assert torch.equal(seen, data["state"][:, [1, 3]])
    with pytest.raises(ValueError, match="hides column 4, the state has 4"):
        apply_regime(data, Regime("dark", "", hidden=(4,)))
    with pytest.raises(ValueError, match="unknown regime 'wide_65'; did you mean 'wide_64'"):
        apply_regime(data, "wide_65")
