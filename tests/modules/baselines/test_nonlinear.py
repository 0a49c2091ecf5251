# This source code is licensed under the MIT license found in the LICENSE file.
"""KOAP with nonlinear maps: plain loops, which term trains what, learning."""

from __future__ import annotations

import pytest
import torch
from inverse_dynamics_test_base import (
    ACTION,
    STATE,
    InverseDynamicsTestBase,
    T,
    normalizers,
    partly_labelled,
    reached,
)
from tensordict import TensorDict

from torchrl_koap.modules import NonlinearInverseDynamics
from torchrl_koap.objectives import KOAPLoss

SPAN = range(2, 6)


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    sizes = {"latent_dim": 6, "hidden_dims": (16,), "lifting_dims": (12,), "num_past": 2, "look_ahead": (2, 3)}
    return NonlinearInverseDynamics(3, 2, **sizes, **normalizers(), **options)


class TestNonlinearInverseDynamics(InverseDynamicsTestBase):
    def make_network(self, seed=0, **options):
        return make_network(seed, **options)


def in_plain_loops(network, batch):
    """The three terms from the definition."""
    scales = network.reader.scales
    terms = {"loss_reconstruction": [], "loss_koopman": [], "loss_action": []}
    for window in range(len(batch)):
        x = (batch["state"][window] - STATE["offset"]) / STATE["scale"]
        z = [network.lifting.encoder(row) for row in x]
        terms["loss_reconstruction"] += [((network.lifting.decoder(z[t]) - x[t]) ** 2).mean() for t in range(T)]
        for t in SPAN:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            read = [x[t - 1] - x[t - 2], x[t] - x[t - 1], x[t], x[t + 2] - x[t], x[t + 3] - x[t + 2]]
            u = network.latent_action.network((torch.stack(read) / scales).flatten())
            terms["loss_koopman"].append(((network.dynamics(torch.cat([z[t], u])) - z[t + 1]) ** 2).mean())
            if batch["has_action"][window, t]:
                target = (batch["action"][window, t] - ACTION["offset"]) / ACTION["scale"]
                terms["loss_action"].append(((network.action_decoder(u) - target) ** 2).mean())
    return {key: torch.stack(values).mean() for key, values in terms.items()}


def test_values_and_gradients_in_plain_loops():
    network, batch = make_network(), partly_labelled(6)
    network.prepare(batch["state"])
    assert (network.reader.scales != 1).any()
    expected, losses = in_plain_loops(network, batch), KOAPLoss(network)(batch)
    parameters = list(network.parameters())
    for key, value in losses.items():
        torch.testing.assert_close(value, expected[key])
        wanted = torch.autograd.grad(expected[key], parameters, retain_graph=True, allow_unused=True)
        actual = torch.autograd.grad(value, parameters, retain_graph=True, allow_unused=True)
        for left, right in zip(actual, wanted, strict=True):
            assert (left is None or (left == 0).all()) if right is None else torch.allclose(left, right, atol=1e-6)


def test_one_term_trains_only_what_it_should():
    network = make_network()
    losses = KOAPLoss(network)(partly_labelled(6))
    assert {key: reached(network, value) for key, value in losses.items()} == {
        "loss_reconstruction": {"lifting"},
        "loss_koopman": {"lifting", "latent_action", "dynamics"},
        "loss_action": {"latent_action", "action_decoder"},
    }


def test_the_successor_may_not_be_read():
    with pytest.raises(ValueError, match="look_ahead offsets must be >= 2"):
        NonlinearInverseDynamics(3, 2, look_ahead=(1, 2))


def test_it_learns_curved_actions_from_some_labels_beside_unlabelled_windows():
    """Actions that bend with the step: a = v + v^2 / 2 for paths of random constant velocity v."""
    generator = torch.Generator().manual_seed(0)
    velocity = torch.randn(1280, 1, 2, generator=generator)
    state = torch.randn(1280, 1, 2, generator=generator) + 0.1 * velocity * torch.arange(8.0)[:, None]
    action = (velocity + velocity.square() / 2).expand(-1, 8, -1).clone()
    data = TensorDict({"state": state, "action": action}, [1280])
    data["has_action"] = torch.zeros(1280, 8, 1, dtype=torch.bool)
    data["has_action"][:128] = True
    torch.manual_seed(0)
    network = NonlinearInverseDynamics(2, 2, latent_dim=8, hidden_dims=(64, 64), num_past=1, look_ahead=(2, 3))
    network.prepare(data["state"][:1024])
    loss, unseen = KOAPLoss(network), data[1024:]
    before = loss(unseen)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(250):
        sum(loss(data[torch.randint(1024, (64,), generator=generator)]).values()).backward()
        optimizer.step()
        optimizer.zero_grad()
    after = loss(unseen)
    for key in ("loss_reconstruction", "loss_koopman"):
        assert after[key] < 0.2 * before[key], (key, before[key], after[key])
    error = (network(unseen.select("state"))["action"] - unseen["action"])[:, 1:5].square().mean()
    assert error < 0.1, error  # the mean action has error 1.5, the best linear map of the step 0.5
