# This source code is licensed under the MIT license found in the LICENSE file.
"""The supervised perceptron: the frames it reads, and the next one among them."""

from __future__ import annotations

import pytest
import torch
from inverse_dynamics_test_base import InverseDynamicsTestBase, normalizers

from torchrl_koap.modules import SupervisedInverseDynamics


class TestSupervisedInverseDynamics(InverseDynamicsTestBase):
    reads = (-2, -1, 0, 1, 3)
    latent = False

    def make_network(self, seed=0, **options):
        torch.manual_seed(seed)
        sizes = {"hidden_dims": (8,), "num_past": 2, "look_ahead": (1, 3)}
        return SupervisedInverseDynamics(3, 2, **sizes, **normalizers(), **options)


def test_it_is_told_the_next_state_but_not_the_present_one_again():
    assert SupervisedInverseDynamics(2, 2).num_window_frames == 6
    with pytest.raises(ValueError, match="must be >= 1"):
        SupervisedInverseDynamics(2, 2, look_ahead=0)


def test_steps_are_scaled_in_normalised_units():
    torch.manual_seed(0)
    plain = SupervisedInverseDynamics(3, 2, hidden_dims=(8,))
    scaled = SupervisedInverseDynamics(3, 2, hidden_dims=(8,), **normalizers())
    state = torch.randn(4, 12, 3).cumsum(1)
    plain.prepare(state)
    scaled.prepare(scaled.state_normalizer.inverse(state))
    torch.testing.assert_close(scaled.reader.scales, plain.reader.scales)
