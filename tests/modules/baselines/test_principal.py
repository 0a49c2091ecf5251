# This source code is licensed under the MIT license found in the LICENSE file.
"""The ridge on principal components: components of all windows, their number from held-out labels."""

from __future__ import annotations

import pytest
import torch
from inverse_dynamics_test_base import InverseDynamicsTestBase, normalizers, partly_labelled
from tensordict import TensorDict

from torchrl_koap.modules import PrincipalInverseDynamics


def make_windows(columns=3, num=80):
    torch.manual_seed(0)
    return torch.randn(num, 17, columns).cumsum(1)


class TestPrincipalInverseDynamics(InverseDynamicsTestBase):
    def make_network(self, seed=0, **options):
        torch.manual_seed(seed)
        sizes = {"counts": (4,), "num_past": 2, "look_ahead": (2, 3)}
        return PrincipalInverseDynamics(3, 2, **sizes, **normalizers(), **options)

    def fitted(self, network):
        network = super().fitted(network)
        network.finish(partly_labelled(20)["state"].to(network.state_normalizer.scale))
        return network


@pytest.mark.parametrize("num", [30, 400])  # fewer windows than columns, and more
def test_components_are_those_of_the_windows(num):
    states = make_windows(num=num)
    model = PrincipalInverseDynamics(3, 2, counts=(8,))
    model.prepare(states)
    model.finish(states)
    rows = model.reader(states, range(8, 9)).flatten(0, -2).double()
    expected = torch.linalg.svd(rows, full_matrices=False)[2][:8]
    torch.testing.assert_close((model.basis.double() @ expected.mT).abs(), torch.eye(8).double(), atol=1e-3, rtol=0)


def test_the_number_of_components_is_chosen_by_labels_left_out():
    states = make_windows()
    windows = TensorDict({"state": states, "action": (states.roll(-2, 1) - states)[..., :2]}, [80])
    model = PrincipalInverseDynamics(3, 2, counts=(2, 48))
    model.prepare(states)
    model.finish(states)
    mask = torch.zeros(80, 17, dtype=torch.bool)
    mask[:, 8] = True
    fit = model.fit_labels(windows, mask, groups=torch.arange(80) // 10)
    assert int(model.gate.sum()) == 48 and fit["labels_used"] == 80
    error = (model(windows.select("state"))["action"] - windows["action"])[:, 8].square().mean().sqrt()
    assert error < 0.1 * windows["action"].square().mean().sqrt()


def test_more_components_than_columns_are_not_asked_for():
    model = PrincipalInverseDynamics(1, 1)
    assert model.basis.shape == (16, 16)
