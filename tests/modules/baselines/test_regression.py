# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests ridge regressions on linear systems and hidden labels; components of windows, and their number."""

import pytest
import torch
from inverse_dynamics_test_base import InverseDynamicsTestBase, normalizers, partly_labelled
from tensordict import TensorDict

from torchrl_koap.modules import LinearInverseDynamics, PrincipalInverseDynamics

COUNTS = "torchrl_koap.modules.baselines.regression.COUNTS"


class TestLinearInverseDynamics(InverseDynamicsTestBase):
    latent = False

    def make_network(self, seed=0, **options):
        torch.manual_seed(seed)
        return LinearInverseDynamics(3, 2, num_past=2, look_ahead=(2, 3), **normalizers(), **options)


def linear_windows(*batch, seed=0):
    """Actions that are a fixed affine map of x_{t-2}, x_{t-1}, x_t, x_{t+5}, where these lie in the window."""
    generator, fixed = torch.Generator().manual_seed(seed), torch.Generator().manual_seed(99)
    state = torch.randn(*batch, 12, 3, generator=generator, dtype=torch.float64)
    true = torch.randn(2, 4 * 3, generator=fixed, dtype=torch.float64)
    read = torch.cat([state.roll(shift, -2) for shift in (2, 1, 0, -5)], -1)
    return TensorDict({"state": state, "action": read @ true.T + torch.tensor([0.5, -2.0])}, batch)


def test_ridge_recovers_a_linear_system_and_generalises():
    model = LinearInverseDynamics(3, 2, num_past=2, look_ahead=5).double()
    windows = linear_windows(40)
    fit = model.fit_labels(windows, torch.ones(40, 12, dtype=torch.bool))
    assert fit["labels_used"] == 40 * 5  # frames 2..6 see everything
    unseen = linear_windows(6, 2, seed=1)
    predicted = model(unseen.clone())["action"]
    torch.testing.assert_close(predicted[..., 2:7, :], unseen["action"][..., 2:7, :], atol=1e-4, rtol=0)


def test_ridge_reads_no_action_outside_the_mask():
    windows, mask = linear_windows(40), torch.zeros(40, 12, dtype=torch.bool)
    mask[:5] = True
    models = [LinearInverseDynamics(3, 2, num_past=2, look_ahead=5).double() for _ in range(2)]
    models[0].fit_labels(windows, mask)
    poisoned = windows.clone()
    poisoned["action"][5:] = 1e9
    models[1].fit_labels(poisoned, mask)
    for name, value in models[0].state_dict().items():
        assert torch.equal(value, models[1].state_dict()[name]), name


def make_windows(columns=3, num=80):
    torch.manual_seed(0)
    return torch.randn(num, 17, columns).cumsum(1)


class TestPrincipalInverseDynamics(InverseDynamicsTestBase):
    def make_network(self, seed=0, **options):
        torch.manual_seed(seed)
        return PrincipalInverseDynamics(3, 2, num_past=2, look_ahead=(2, 3), **normalizers(), **options)

    def fitted(self, network):
        network = super().fitted(network)
        network.finish(partly_labelled(20)["state"].to(network.state_normalizer.scale))
        return network


@pytest.mark.parametrize("num", [30, 400])  # fewer windows than columns, and more
def test_components_are_those_of_the_windows(num, monkeypatch):
    monkeypatch.setattr(COUNTS, (8,))
    states = make_windows(num=num)
    model = PrincipalInverseDynamics(3, 2)
    model.prepare(states)
    model.finish(states)
    rows = model.reader(states, range(8, 9)).flatten(0, -2).double()
    expected = torch.linalg.svd(rows, full_matrices=False)[2][:8]
    torch.testing.assert_close((model.basis.double() @ expected.mT).abs(), torch.eye(8).double(), atol=1e-3, rtol=0)


def test_the_number_of_components_is_chosen_by_labels_left_out(monkeypatch):
    monkeypatch.setattr(COUNTS, (2, 48))
    states = make_windows()
    action = (states.roll(-2, 1) - states)[..., :2]
    windows = TensorDict({"state": states, "action": action, "episode": torch.arange(80) // 10}, [80])
    model = PrincipalInverseDynamics(3, 2)
    model.prepare(states)
    model.finish(states)
    mask = torch.zeros(80, 17, dtype=torch.bool)
    mask[:, 8] = True
    fit = model.fit_labels(windows, mask)
    assert int(model.gate.sum()) == 48 and fit["labels_used"] == 80
    error = (model(windows.select("state"))["action"] - windows["action"])[:, 8].square().mean().sqrt()
    assert error < 0.1 * windows["action"].square().mean().sqrt()


def test_more_components_than_columns_are_not_asked_for():
    model = PrincipalInverseDynamics(1, 1)
    assert model.basis.shape == (16, 16)
