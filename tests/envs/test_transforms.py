# This source code is licensed under the MIT license found in the LICENSE file.
"""Noise of a stated size on the end effector, in specs, rollouts and any batch."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_koap.envs import SortingEnv
from torchrl_koap.envs.transforms import EndEffectorNoise
from torchrl_koap.tasks import get_task


def test_specs_stay_those_of_the_environment():
    check_env_specs(TransformedEnv(SortingEnv(2, seed=0), EndEffectorNoise("po_sorting", sigma=0.002)))


def test_noise_has_the_stated_size_and_touches_nothing_else():
    noisy = EndEffectorNoise("aligning", sigma=0.003)
    clean = torch.zeros(4000, 20)
    found = noisy(TensorDict({"observation": clean}, [4000]))["observation"]
    measured = get_task("aligning").observation["measured_xyz"]
    assert found[:, measured].std().item() == pytest.approx(0.003, rel=0.03)
    assert found[:, measured].mean().abs() < 2e-4
    rest = [column for column in range(20) if column not in range(3, 6)]
    assert not found[:, rest].any() and not clean.any()


def test_a_negative_sigma_is_refused():
    with pytest.raises(ValueError, match="sigma must be >= 0, got -1"):
        EndEffectorNoise("sorting", sigma=-1)
