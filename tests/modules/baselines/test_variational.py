# This source code is licensed under the MIT license found in the LICENSE file.
"""The auto-encoder of whole windows: what it reads and reconstructs, samples that are decoded, learning."""

from __future__ import annotations

import pytest
import torch
from inverse_dynamics_test_base import (
    KEYS,
    STATE,
    InverseDynamicsTestBase,
    T,
    few_labels,
    normalizers,
    partly_labelled,
    reached,
    recorded,
    train,
)
from loss_test_base import LossTestBase

from torchrl_koap.modules import SupervisedInverseDynamics, VariationalInverseDynamics
from torchrl_koap.objectives import ActionLoss, VariationalLoss

SPAN = range(1, T - 1)


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    return VariationalInverseDynamics(3, 2, window=T, latent_dim=4, hidden_dim=8, **normalizers(), **options)


def make_batch(*batch):
    noise = torch.randn(*batch, len(SPAN), 4, generator=torch.Generator().manual_seed(5))
    return partly_labelled(*batch).set("latent_noise", noise)


class TestVariationalInverseDynamics(InverseDynamicsTestBase):
    def make_network(self, seed=0, **options):
        return make_network(seed, **options)

    def test_an_action_depends_on_the_frames_it_may_read_and_no_others(self):
        network, state = self.make_network(), partly_labelled(1)["state"][0]
        latent = network.infer(state)
        for changed in (0, T - 1):  # of every frame, the whole window
            other = state.clone()
            other[changed] += 1
            assert (network.infer(other) != latent).any(-1).all()
        assert network.valid_frames(T) == SPAN and network.num_window_frames == T and network.num_past == 1


class TestVariationalLoss(LossTestBase):
    default_keys = {**KEYS, "noise": "latent_noise"}
    in_names, out_keys = ("state",), ("loss_reconstruction", "loss_kl")
    coefficients = {"kl_coeff": "loss_kl"}
    learning_rate = 1e-2
    test_compiled_equals_eager = None  # torch's LSTM in two directions is not traced

    def make_loss(self, seed=0, **options):
        return VariationalLoss(make_network(seed), **{"kl_coeff": 1.0, **options})

    def make_batch(self, *batch):
        return make_batch(*batch)

    def counted(self, batch, key, elements):
        counts = recorded(batch, SPAN)
        assert (elements[~counts] == 0).all() and (elements[counts] > 0).all()
        return int(counts.sum())


def in_plain_loops(network, batch):
    """Terms of every frame that counts, from the definition."""
    reconstruction, divergence = [], []
    for window in range(len(batch)):
        x = (batch["state"][window] - STATE["offset"]) / STATE["scale"]
        ends = [x[:1], x, x[-1:]]
        steps = torch.cat(ends).diff(dim=0)
        read = torch.cat([steps[:-1], x, steps[1:]], -1)
        context, _ = network.context(read[None])
        for t in SPAN:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            mean, log_variance = network.encoder(context[0, t]).split(4)
            sample = mean + torch.exp(log_variance / 2) * batch["latent_noise"][window, t - SPAN.start]
            reconstruction.append(((network.decoder(sample) - read[t]) ** 2).mean())
            normal = torch.distributions.Normal(mean, torch.exp(log_variance / 2))
            divergence.append(torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).sum())
    return torch.stack(reconstruction).mean(), torch.stack(divergence).mean()


def test_values_in_plain_loops():
    network, batch = make_network(), make_batch(6)
    assert 0 < recorded(batch, SPAN).sum() < recorded(batch, SPAN).numel()
    reconstruction, divergence = in_plain_loops(network, batch)
    losses = VariationalLoss(network)(batch)
    torch.testing.assert_close(losses["loss_reconstruction"], reconstruction)
    torch.testing.assert_close(losses["loss_kl"], 0.01 * divergence)


def test_noise_is_drawn_anew_where_none_is_handed_in_and_a_wrong_one_is_refused():
    loss, batch = VariationalLoss(make_network()), make_batch(6)
    free = batch.exclude("latent_noise")
    assert loss(free)["loss_reconstruction"] != loss(free)["loss_reconstruction"]
    assert loss(free)["loss_kl"] == loss(batch)["loss_kl"]  # the divergence is not sampled
    batch["latent_noise"] = torch.zeros(6, T, 4)
    with pytest.raises(ValueError, match=r"'latent_noise' must be \[6, 7, 4\], got \[6, 9, 4\]"):
        loss(batch)


def test_a_far_window_stays_finite():
    network, batch = make_network(), make_batch(6)
    batch["state"] *= 1e5
    losses = VariationalLoss(network)(batch)
    sum(losses.values()).backward()
    assert all(value.isfinite() for value in losses.values())
    assert all(value.grad is None or value.grad.isfinite().all() for value in network.parameters())


def test_each_stage_trains_what_it_should():
    network, batch = make_network(), make_batch(6)
    assert reached(network, sum(VariationalLoss(network)(batch).values())) == {"context", "encoder", "decoder"}
    loss = ActionLoss(network, freeze_latents=True, sample=True)
    assert reached(network, loss(batch)["loss_action"]) == {"action_decoder"}


def test_the_action_decoder_is_fitted_to_samples_and_acts_on_the_mean():
    network, batch = make_network(), make_batch(6)
    loss = ActionLoss(network, freeze_latents=True, sample=True)
    assert loss(batch)["loss_action"] != loss(batch)["loss_action"]
    written = network(batch.select("state"))
    assert torch.equal(written["action"], network(batch.select("state"))["action"])
    assert torch.equal(written["latent_action"], network.posterior(batch["state"])[1])


def test_samples_and_frozen_latents_need_a_network_that_has_them():
    supervised = SupervisedInverseDynamics(2, 2)
    for asked, message in (
        ({"sample": True}, "samples were asked"),
        ({"freeze_latents": True}, "freeze_latents was asked"),
    ):
        with pytest.raises(ValueError, match=f"{message} for, but SupervisedInverseDynamics has no latents"):
            ActionLoss(supervised, **asked)


def test_two_stages_learn_actions_from_few_labels():
    data = few_labels()
    torch.manual_seed(0)
    network = VariationalInverseDynamics(2, 2, window=12, hidden_dim=32)
    network.prepare(data["state"][:1024])
    decoder = ActionLoss(network, freeze_latents=True, sample=True)
    train(network, data, (VariationalLoss(network), 200, 1024), (decoder, 200, 32))
    unseen = data[1024:]
    error = (network(unseen.select("state"))["action"] - unseen["action"])[:, 1:10].square().mean()
    assert error < 0.2, error  # the mean action has error 1
