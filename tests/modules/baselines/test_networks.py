# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the supervised perceptron and nonlinear KOAP: frames read, plain loops, gradients of each term."""

import torch
from inverse_dynamics_test_base import ACTION, STATE, InverseDynamicsTestBase, T, normalizers, partly_labelled

from torchrl_koap.modules import NonlinearInverseDynamics, SupervisedInverseDynamics
from torchrl_koap.objectives import KOAPLoss

SPAN = range(2, 6)


class TestSupervisedInverseDynamics(InverseDynamicsTestBase):
    reads = (-2, -1, 0, 1, 3)
    latent = False

    def make_network(self, seed=0, **options):
        torch.manual_seed(seed)
        return SupervisedInverseDynamics(3, 2, num_past=2, look_ahead=(1, 3), **normalizers(), **options)


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    return NonlinearInverseDynamics(3, 2, num_past=2, look_ahead=(2, 3), **normalizers(), **options)


class TestNonlinearInverseDynamics(InverseDynamicsTestBase):
    make_network = staticmethod(make_network)


def in_plain_loops(network, batch):
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
