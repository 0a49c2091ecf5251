# This source code is licensed under the MIT license found in the LICENSE file.
"""Base class of tests for the losses of planner and Diffusion Policy, and the formula of the noise."""

import pytest
import torch
from loss_test_base import LossTestBase
from torchrl.objectives import HardUpdate, SoftUpdate


def noised(network, clean, noise, time):
    """Returns noised sequences by the formula of the schedule."""
    signal = network.schedule.signal.to(clean.dtype)[time.long()][:, None, None]
    return signal * clean + (1 - signal**2).sqrt() * noise


class DenoisingLossTestBase(LossTestBase):
    def weights(self, loss):
        return loss.network_params.flatten_keys(".")

    def test_gradients_are_finite_and_reach_every_weight_but_not_the_statistics(self):
        loss = self.make_loss()
        self.total(loss(self.make_batch(16))).backward()
        weights = dict(self.weights(loss).items())
        trained = {name for name, value in weights.items() if value.requires_grad}
        assert trained == {name for name, _ in loss.network.named_parameters()}
        for name in trained:
            assert weights[name].grad.isfinite().all() and weights[name].grad.abs().max() > 0, name

    def test_average_of_the_weights_follows_the_formula(self):
        loss, batch = self.make_loss(), self.make_batch(8)
        average, before = SoftUpdate(loss, eps=0.9), {name: value.clone() for name, value in self.weights(loss).items()}
        self.total(loss(batch)).backward()
        torch.optim.SGD(loss.parameters(), lr=0.1).step()
        average.step()
        target = loss.target_network_params.flatten_keys(".")
        for name, value in self.weights(loss).items():
            torch.testing.assert_close(target[name], 0.9 * before[name] + 0.1 * value if value.requires_grad else value)
            assert not target[name].requires_grad
        network = loss.network
        history, noise = torch.randn(3, network.history, network.state_dim), torch.randn(3, *network.noise_shape)
        trained = network.sample(history, noise)
        with loss.target_network_params.to_module(network, preserve_module_state=False):
            averaged = network.sample(history, noise)
        assert not torch.allclose(trained, averaged)
        torch.testing.assert_close(network.sample(history, noise), trained)
        HardUpdate(loss, value_network_update_interval=1).step()  # raises if the average requires gradients
        assert any("target" in name for name in loss.state_dict())
        assert not any("target" in name for name in self.make_loss(create_target_params=False).state_dict())

    def test_noise_is_drawn_anew_at_every_call(self):
        loss, batch = self.make_loss(), self.make_batch(8)
        batch = batch.exclude(self.default_keys["noise"], self.default_keys["time"])
        assert self.total(loss(batch)) != self.total(loss(batch))

    def test_the_mode_reaches_the_network(self):
        loss = self.make_loss()
        assert not loss.eval().network.training and loss.train().network.training

    def test_entries_set_by_hand_are_refused(self):
        with pytest.raises(AttributeError, match="in_keys"):
            self.make_loss().in_keys = ["x"]
