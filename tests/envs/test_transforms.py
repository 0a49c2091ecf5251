# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests partial observability: dropped columns and noise of a given size in specs, rollouts and batches."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_koap.envs import AvoidingEnv, SortingEnv
from torchrl_koap.envs.transforms import EndEffectorNoise, PartialObservation
from torchrl_koap.tasks import get_task


def test_po_sorting_is_sorting_plus_transforms():
    env = TransformedEnv(
        SortingEnv(2, seed=0), Compose(EndEffectorNoise("po_sorting", sigma=0.002), PartialObservation("po_sorting"))
    )
    check_env_specs(env)
    assert env.observation_spec["observation"].shape == (2, 10)
    data = env.rollout(3)
    assert data["observation"].shape == (2, 3, 10) and data["next", "observation"].shape == (2, 3, 10)


def test_what_remains_is_what_the_task_shows_its_planner():
    observation, hide = torch.randn(7, 16), PartialObservation("po_sorting")
    partial = hide(TensorDict({"observation": observation.clone()}, [7]))["observation"]
    assert torch.equal(partial, observation[:, [2, 3, 4, 5, 7, 8, 10, 11, 13, 14]])
    with pytest.raises(ValueError, match="has 16 columns, got 20"):
        hide(TensorDict({"observation": torch.zeros(1, 20)}, [1]))


def test_noise_has_the_stated_size_and_touches_nothing_else():
    noisy = EndEffectorNoise("aligning", sigma=0.003)
    clean = torch.zeros(4000, 20)
    found = noisy(TensorDict({"observation": clean}, [4000]))["observation"]
    measured = get_task("aligning").observation["measured_xyz"]
    assert found[:, measured].std().item() == pytest.approx(0.003, rel=0.03)
    assert found[:, measured].mean().abs() < 2e-4
    rest = [column for column in range(20) if column not in range(3, 6)]
    assert not found[:, rest].any() and not clean.any()


def test_noise_is_independent_unless_seeds_are_given():
    first, second = EndEffectorNoise("aligning", sigma=1.0), EndEffectorNoise("aligning", sigma=1.0)
    zeros = TensorDict({"observation": torch.zeros(2, 20)}, [2])
    assert not torch.equal(first(zeros.copy())["observation"], second(zeros.copy())["observation"])
    for noise in (first, second):
        noise.seed_episodes([3, 4])
    both = first(zeros.copy())["observation"]
    assert torch.equal(both, second(zeros.copy())["observation"])
    first.seed_episodes([4])  # an episode depends on its own seed alone
    assert torch.equal(first(zeros[1:].copy())["observation"], both[1:]) and not torch.equal(both[0], both[1])


@pytest.mark.parametrize("seeds", [(3, 4), None])
def test_an_environment_that_a_mask_leaves_out_keeps_its_noise(seeds):
    """Else its episode would depend on when the others of the batch begin or wait."""
    noise = EndEffectorNoise("avoiding", sigma=1.0)
    env, stay = TransformedEnv(AvoidingEnv(2), noise), torch.zeros(2, 2)
    if seeds:
        noise.seed_episodes(seeds)
    data = env.reset()
    first = [data["observation"].clone()]
    data["_reset"] = torch.tensor([[True], [False]])
    data = env.reset(data)
    assert torch.equal(data["observation"][1], first[0][1]) and not torch.equal(data["observation"][0], first[0][0])
    data.update({"action": stay, "_step": torch.tensor([False, True])})
    waited = env.step(data)["next", "observation"]
    assert torch.equal(waited[0], data["observation"][0]) and not torch.equal(waited[1], data["observation"][1])
    if seeds:
        noise.seed_episodes(seeds)
        data = env.reset()
        alone = env.step(data.set("action", stay))["next", "observation"]
        assert torch.equal(waited[1], alone[1])


def test_a_mask_of_an_environment_without_batch_is_no_mask_of_its_columns():
    noise, seen = EndEffectorNoise("avoiding", sigma=1.0), TensorDict({"observation": torch.zeros(4)})
    for _ in range(2):
        before = seen["observation"]
        noise._reset(TensorDict({"_reset": torch.tensor([True])}), seen)
        assert (seen["observation"] != before)[noise.part].all()


@pytest.mark.parametrize("sigma", [-1, float("nan")])
def test_a_negative_sigma_is_refused(sigma):
    with pytest.raises(ValueError, match=f"sigma must be >= 0, got {sigma}"):
        EndEffectorNoise("sorting", sigma=sigma)
