# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests scores of sampled sequences against recorded ones."""

import math

import pytest
import torch

from torchrl_koap.modules import StatePlanner, TemporalUnet
from torchrl_koap.modules.planning.energy_score import (
    energy_score,
    relative_distance,
    relative_score,
    sample_sequences,
)


def test_the_energy_score_is_least_for_the_true_distribution():
    generator = torch.Generator().manual_seed(0)
    true = torch.randn(4000, 3, generator=generator)
    scores = [energy_score(scale * torch.randn(16, 4000, 3, generator=generator), true).mean() for scale in (1, 0, 2)]
    assert scores[0] < scores[1] and scores[0] < scores[2]
    torch.testing.assert_close(energy_score(torch.zeros(16, 4000, 3), true), true.norm(dim=-1))
    left_or_right = torch.tensor([[-1.0], [1.0], [-1.0], [1.0]])
    torch.testing.assert_close(energy_score(left_or_right, torch.ones(1)), torch.tensor(1 / 3))
    with pytest.raises(ValueError, match=r"wanted samples \[S, \*B, d\] and true \[\*B, d\], got \[3, 2\], \[3, 2\]"):
        energy_score(torch.zeros(3, 2), torch.zeros(3, 2))


def test_the_relative_score_is_a_mean_of_shares_over_the_columns_that_move():
    true = torch.tensor([[[2.0, 10.0, 5.0]]])  # [N, H, d]
    still = torch.tensor([[[0.0, 0.0, 5.0]]])
    samples = torch.tensor([[[[1.0, 10.0, 9.0]]]])  # half the error in the first column, none in the second
    assert relative_score(samples, true, still, [[0], [1], [2]]) == pytest.approx(0.25)
    assert math.isnan(relative_score(samples, true, still, [[2]]))


def test_the_relative_distance_is_that_to_the_nearest_recorded_sequence():
    recorded = torch.tensor([[[0.0, 7.0, 0.0]], [[10.0, 7.0, 0.0]], [[20.0, 7.0, 0.0]]])  # [M, H, d]
    true = torch.tensor([[[11.0, 7.0, 0.5]]])  # [N, H, d]: 1 and 0.5 away
    samples = torch.tensor([[[[14.0, 9.0, 1.0]]], [[[20.0, 7.0, 0.0]]]])  # 4 and 0 away, 1 and 0
    assert relative_distance(samples, true, recorded, [[0]]) == pytest.approx(2.0)
    assert relative_distance(samples, true, recorded, [[0], [1], [2]]) == pytest.approx(1.5), "no share of column 1"
    assert relative_distance(samples, true, recorded, [[1]]) == 1.0
    far = 1e4 + torch.tensor([[[0.0]], [[0.1]]])  # small distances between places far from zero
    assert relative_distance(far[None, 1:] + 0.01, far[1:] + 0.02, far, [[0]]) == pytest.approx(0.5, rel=0.02)


def test_samples_depend_on_their_seed_alone():
    planner = StatePlanner(TemporalUnet(2, 4, channels=(8,)), state_dim=2, num_steps=2).eval()
    history = torch.randn(3, 2, 2)
    before = torch.get_rng_state()
    first, again, other = (sample_sequences(planner, history, samples=4, seed=seed) for seed in (0, 0, 1))
    assert first.shape == (4, 3, 14, 2)
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.equal(torch.get_rng_state(), before)
