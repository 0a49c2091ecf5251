# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests latents without labels against plain loops: codes, the window auto-encoder, trained weights per stage."""

import math

import pytest
import torch
from inverse_dynamics_test_base import (
    ACTION,
    KEYS,
    STATE,
    InverseDynamicsTestBase,
    T,
    normalizers,
    partly_labelled,
    reached,
    recorded,
)
from loss_test_base import LossTestBase

from torchrl_koap.modules import QuantizedInverseDynamics, SupervisedInverseDynamics, VariationalInverseDynamics
from torchrl_koap.modules.baselines.latents import FiniteScalarQuantizer
from torchrl_koap.objectives import ActionLoss, QuantizedDynamicsLoss, VariationalLoss

SPAN = range(2, 6)
LEVELS = "torchrl_koap.modules.baselines.latents.LEVELS"


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    return QuantizedInverseDynamics(3, 2, num_past=2, look_ahead=(1, 3), **normalizers(), **options)


class TestQuantizedInverseDynamics(InverseDynamicsTestBase):
    reads = (-2, -1, 0, 1, 3)

    make_network = staticmethod(make_network)


class TestQuantizedDynamicsLoss(LossTestBase):
    default_keys = KEYS
    in_names, out_keys = ("state",), ("loss_dynamics",)
    learning_rate = 1e-2

    def make_loss(self, seed=0, **options):
        return QuantizedDynamicsLoss(make_network(seed), **options)

    def make_batch(self, *batch):
        return partly_labelled(*batch, spread=2.0)

    def counted(self, batch, key, elements):
        counts = recorded(batch, SPAN)
        assert (elements[~counts] == 0).all() and (elements[counts] > 0).all()
        return int(counts.sum())


def test_values_in_plain_loops():
    network, batch = make_network(), partly_labelled(6, spread=2.0)
    scales = torch.rand(5, 3, generator=torch.Generator().manual_seed(1)) + 0.5
    scales[2] = 1.0
    network.reader.scales.copy_(scales)
    dynamics, action = [], []
    for window in range(6):
        x = (batch["state"][window] - STATE["offset"]) / STATE["scale"]
        for t in SPAN:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            past = [(x[t - 1] - x[t - 2]) / scales[0], (x[t] - x[t - 1]) / scales[1], x[t]]
            step = (x[t + 1] - x[t]) / scales[3]
            latent = network.quantizer(network.encoder(torch.cat([*past, step, (x[t + 3] - x[t + 1]) / scales[4]])))
            dynamics.append(((network.dynamics(torch.cat([*past, latent])) - step) ** 2).mean())
            if batch["has_action"][window, t]:
                target = (batch["action"][window, t] - ACTION["offset"]) / ACTION["scale"]
                action.append(((network.action_decoder(latent) - target) ** 2).mean())
    assert 5 < len(action) < len(dynamics) < 6 * len(SPAN)
    torch.testing.assert_close(QuantizedDynamicsLoss(network)(batch)["loss_dynamics"], torch.stack(dynamics).mean())
    loss = ActionLoss(network, freeze_latents=True)(batch)["loss_action"]
    torch.testing.assert_close(loss, torch.stack(action).mean())


def test_each_stage_trains_what_it_should():
    network, batch = make_network(), partly_labelled(6)
    dynamics = QuantizedDynamicsLoss(network)(batch)["loss_dynamics"]
    assert reached(network, dynamics) == {"encoder", "quantizer", "dynamics"}
    action = ActionLoss(network, freeze_latents=True)(batch)["loss_action"]
    assert reached(network, action) == {"action_decoder"}
    assert reached(network, ActionLoss(network)(batch)["loss_action"]) == {"action_decoder", "encoder", "quantizer"}


def test_look_ahead_must_hold_the_transition():
    with pytest.raises(ValueError, match=r"look_ahead must contain 1, .* got \(2, 3\)"):
        QuantizedInverseDynamics(3, 2, look_ahead=(2, 3))


class TestFiniteScalarQuantizer:
    @pytest.mark.parametrize("levels", [(8, 5, 5, 5), (3, 4), (6,), (5, 3, 8)])
    def test_every_level_is_reached_and_no_other(self, levels, monkeypatch):
        monkeypatch.setattr(LEVELS, levels)
        quantizer = FiniteScalarQuantizer(7).double()
        grid = torch.linspace(-9, 9, 4001, dtype=torch.float64)[:, None].expand(-1, len(levels))
        codes = quantizer.quantize(grid)
        for column, count in enumerate(levels):
            half = count // 2
            expected = torch.arange(-half, count - half, dtype=torch.float64) / half
            assert torch.equal(codes[:, column].unique(), expected)
            assert (codes[1:, column] >= codes[:-1, column]).all()
        assert codes.abs().max() == 1

    def test_gradients_are_those_of_the_bounded_value(self):
        quantizer = FiniteScalarQuantizer(7).double()
        values = (5 * torch.rand(50, 8, dtype=torch.float64) - 2.5).requires_grad_()
        (straight,) = torch.autograd.grad(quantizer.quantize(values).sum(), values)
        levels = torch.tensor([8.0, 5.0, 5.0, 5.0] * 2, dtype=torch.float64)
        half_range, shift = (levels - 1) / 2, torch.tensor([math.atanh(0.5 / 3.5), 0, 0, 0] * 2, dtype=torch.float64)
        expected = half_range / (levels // 2) * (1 - torch.tanh(values.detach() + shift) ** 2)
        torch.testing.assert_close(straight, expected)
        quantizer(torch.randn(5, 7, dtype=torch.float64)).sum().backward()
        assert all(value.grad.isfinite().all() and (value.grad != 0).any() for value in quantizer.parameters())


WHOLE = range(1, T - 1)


def make_autoencoder(seed=0, **options):
    torch.manual_seed(seed)
    return VariationalInverseDynamics(3, 2, **normalizers(), **options)


def noisy_windows(*batch):
    noise = torch.randn(*batch, len(WHOLE), 16, generator=torch.Generator().manual_seed(5))
    return partly_labelled(*batch).set("latent_noise", noise)


class TestVariationalInverseDynamics(InverseDynamicsTestBase):
    vectorized = False  # its LSTM is torch's
    make_network = staticmethod(make_autoencoder)

    def test_an_action_depends_on_the_frames_it_may_read_and_no_others(self):
        network, state = self.make_network(), partly_labelled(1)["state"][0]
        latent = network.infer(state)
        for changed in (0, T - 1):  # of every frame, the whole window
            other = state.clone()
            other[changed] += 1
            assert (network.infer(other) != latent).any(-1).all()
        assert network.valid_frames(T) == WHOLE and network.num_window_frames == 16 and network.num_past == 1


class TestVariationalLoss(LossTestBase):
    default_keys = {**KEYS, "noise": "latent_noise"}
    in_names, out_keys = ("state",), ("loss_reconstruction", "loss_kl")
    coefficients = {"kl_coeff": "loss_kl"}
    learning_rate = 1e-2
    test_compiled_equals_eager = None  # torch's LSTM in two directions is not traced

    def make_loss(self, seed=0, **options):
        return VariationalLoss(make_autoencoder(seed), **{"kl_coeff": 1.0, **options})

    make_batch = staticmethod(noisy_windows)

    def counted(self, batch, key, elements):
        counts = recorded(batch, WHOLE)
        assert (elements[~counts] == 0).all() and (elements[counts] > 0).all()
        return int(counts.sum())


def autoencoder_terms(network, batch):
    reconstruction, divergence = [], []
    for window in range(len(batch)):
        x = (batch["state"][window] - STATE["offset"]) / STATE["scale"]
        ends = [x[:1], x, x[-1:]]
        steps = torch.cat(ends).diff(dim=0)
        read = torch.cat([steps[:-1], x, steps[1:]], -1)
        context, _ = network.context(read[None])
        for t in WHOLE:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            mean, log_variance = network.encoder(context[0, t]).split(16)
            sample = mean + torch.exp(log_variance / 2) * batch["latent_noise"][window, t - WHOLE.start]
            reconstruction.append(((network.decoder(sample) - read[t]) ** 2).mean())
            normal = torch.distributions.Normal(mean, torch.exp(log_variance / 2))
            divergence.append(torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).sum())
    return torch.stack(reconstruction).mean(), torch.stack(divergence).mean()


def test_values_autoencoder_terms():
    network, batch = make_autoencoder(), noisy_windows(6)
    assert 0 < recorded(batch, WHOLE).sum() < recorded(batch, WHOLE).numel()
    reconstruction, divergence = autoencoder_terms(network, batch)
    losses = VariationalLoss(network)(batch)
    torch.testing.assert_close(losses["loss_reconstruction"], reconstruction)
    torch.testing.assert_close(losses["loss_kl"], 0.01 * divergence)


def test_noise_is_drawn_anew_where_none_is_handed_in_and_a_wrong_one_is_refused():
    loss, batch = VariationalLoss(make_autoencoder()), noisy_windows(6)
    free = batch.exclude("latent_noise")
    assert loss(free)["loss_reconstruction"] != loss(free)["loss_reconstruction"]
    assert loss(free)["loss_kl"] == loss(batch)["loss_kl"]  # the divergence is not sampled
    batch["latent_noise"] = torch.zeros(6, T, 16)
    with pytest.raises(ValueError, match=r"'latent_noise' must be \[6, 7, 16\], got \[6, 9, 16\]"):
        loss(batch)


def test_a_far_window_stays_finite():
    network, batch = make_autoencoder(), noisy_windows(6)
    batch["state"] *= 1e5
    losses = VariationalLoss(network)(batch)
    sum(losses.values()).backward()
    assert all(value.isfinite() for value in losses.values())
    assert all(value.grad is None or value.grad.isfinite().all() for value in network.parameters())


def test_each_stage_of_the_autoencoder_trains_what_it_should():
    network, batch = make_autoencoder(), noisy_windows(6)
    assert reached(network, sum(VariationalLoss(network)(batch).values())) == {"context", "encoder", "decoder"}
    loss = ActionLoss(network, freeze_latents=True)
    assert reached(network, loss(batch)["loss_action"]) == {"action_decoder"}


def test_the_action_decoder_is_fitted_to_samples_and_acts_on_the_mean():
    network, batch = make_autoencoder(), noisy_windows(6)
    loss = ActionLoss(network, freeze_latents=True)
    assert loss(batch)["loss_action"] != loss(batch)["loss_action"]
    written = network(batch.select("state"))
    assert torch.equal(written["action"], network(batch.select("state"))["action"])
    assert torch.equal(written["latent_action"], network.posterior(batch["state"])[1])


def test_frozen_latents_need_a_network_that_has_them():
    with pytest.raises(ValueError, match="freeze_latents was asked for, but SupervisedInverseDynamics has no latents"):
        ActionLoss(SupervisedInverseDynamics(2, 2), freeze_latents=True)
