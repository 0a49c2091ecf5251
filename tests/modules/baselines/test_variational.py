# This source code is licensed under the MIT license found in the LICENSE file.
"""The variational controller and its losses: plain loops, what may reach what, hidden labels, two stages."""

from __future__ import annotations

import pytest
import torch
from loss_test_base import LossTestBase
from tensordict import TensorDict

from torchrl_koap.modules import Normalizer, VariationalInverseDynamics
from torchrl_koap.objectives import LatentDecoderLoss, VariationalLoss

T, HISTORY, LOOK_AHEAD = 9, 2, (1, 3)
SPAN = range(2, 6)
KEYS = {"state": "state", "action": "action", "has_action": "has_action", "padded": "padded"}


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    return VariationalInverseDynamics(
        3,
        2,
        latent_dim=4,
        hidden_dims=(16,),
        num_past=HISTORY,
        look_ahead=LOOK_AHEAD,
        state_normalizer=Normalizer(torch.tensor([0.1, -0.2, 0.0]), torch.tensor([2.0, 1.0, 3.0])),
        action_normalizer=Normalizer(torch.tensor([0.3, 0.0]), torch.tensor([0.5, 2.0])),
        **options,
    )


def make_batch(*batch, share=0.5):
    generator = torch.Generator().manual_seed(4)
    has_action = torch.rand(*batch, T, 1, generator=generator) < share
    action = torch.where(has_action, torch.randn(*batch, T, 2, generator=generator), torch.nan)
    padded = torch.zeros(*batch, T, dtype=torch.bool)
    padded[..., :3] = torch.rand(*batch, 1, generator=generator) < 0.4
    return TensorDict(
        {
            "state": torch.randn(*batch, T, 3, generator=generator),
            "action": action,
            "has_action": has_action,
            "padded": padded,
            "latent_noise": torch.randn(*batch, len(SPAN), 4, generator=generator),
        },
        batch,
    )


def recorded(batch):
    frames = slice(SPAN.start, SPAN.stop)
    return ~(batch["padded"][..., frames] | batch["padded"][..., SPAN.start + 1 : SPAN.stop + 1])


class TestVariationalLoss(LossTestBase):
    default_keys = {**KEYS, "noise": "latent_noise"}
    in_names, out_keys = ("state",), ("loss_reconstruction", "loss_kl")
    coefficients = {"kl_coeff": "loss_kl"}

    def make_loss(self, seed=0, **options):
        return VariationalLoss(make_network(seed), **{"kl_coeff": 1.0, **options})

    def make_batch(self, *batch):
        return make_batch(*batch)

    def counted(self, batch, key, elements):
        assert (elements[~recorded(batch)] == 0).all() and (elements[recorded(batch)] > 0).all()
        return int(recorded(batch).sum())


class TestLatentDecoderLoss(LossTestBase):
    default_keys = KEYS
    in_names, out_keys = ("state", "action", "has_action"), ("loss_action",)
    learning_rate, decrease = 1e-2, 0.8

    def make_loss(self, seed=0, **options):
        return LatentDecoderLoss(make_network(seed), **options)

    def make_batch(self, *batch):
        return make_batch(*batch)

    def counted(self, batch, key, elements):
        return int((recorded(batch) & batch["has_action"][..., SPAN.start : SPAN.stop, 0]).sum())


# values


def in_plain_loops(network, batch):
    """Terms of every frame that counts, from the definition."""
    offset, scale = network.state_normalizer.offset, network.state_normalizer.scale
    reconstruction, divergence, action = [], [], []
    for window in range(len(batch)):
        x = (batch["state"][window] - offset) / scale
        for t in SPAN:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            before, after = [x[t - 1] - x[t - 2], x[t] - x[t - 1]], [x[t + 1] - x[t], x[t + 3] - x[t + 1]]
            mean, log_variance = network.encoder(torch.cat([*before, x[t], *after])).split(4)
            sample = mean + torch.exp(log_variance / 2) * batch["latent_noise"][window, t - SPAN.start]
            steps = network.decoder(torch.cat([sample, x[t]]))
            reconstruction.append(((steps - torch.cat([*before, *after])) ** 2).mean())
            normal = torch.distributions.Normal(mean, torch.exp(log_variance / 2))
            divergence.append(torch.distributions.kl_divergence(normal, torch.distributions.Normal(0.0, 1.0)).sum())
            if batch["has_action"][window, t]:
                target = (batch["action"][window, t] - torch.tensor([0.3, 0.0])) / torch.tensor([0.5, 2.0])
                action.append(((network.action_decoder(mean) - target) ** 2).mean())
    return [torch.stack(terms).mean() for terms in (reconstruction, divergence, action)]


def test_values_in_plain_loops():
    network, batch = make_network(), make_batch(6)
    assert 0 < recorded(batch).sum() < recorded(batch).numel()
    reconstruction, divergence, action = in_plain_loops(network, batch)
    losses = VariationalLoss(network)(batch)
    torch.testing.assert_close(losses["loss_reconstruction"], reconstruction)
    torch.testing.assert_close(losses["loss_kl"], 0.01 * divergence)
    torch.testing.assert_close(LatentDecoderLoss(network)(batch)["loss_action"], action)


def test_noise_is_drawn_anew_where_none_is_handed_in_and_a_wrong_one_is_refused():
    loss, batch = VariationalLoss(make_network()), make_batch(6)
    free = batch.exclude("latent_noise")
    assert loss(free)["loss_reconstruction"] != loss(free)["loss_reconstruction"]
    assert loss(free)["loss_kl"] == loss(batch)["loss_kl"]  # the divergence is not sampled
    batch["latent_noise"] = torch.zeros(6, T, 4)
    with pytest.raises(ValueError, match=r"'latent_noise' must be \[6, 4, 4\], got \[6, 9, 4\]"):
        loss(batch)


def test_the_reconstruction_sees_the_trajectory_through_the_sample_alone():
    """With all noise and no signal, what is decoded is a function of noise and present state."""
    network, batch = make_network(), make_batch(6)
    with torch.no_grad():
        network.encoder[-1].weight.zero_()
        network.encoder[-1].bias.zero_()
    present, steps = network.split(network.read(batch["state"], SPAN))
    assert torch.equal(present, network.normalize_state(batch["state"])[:, SPAN.start : SPAN.stop])
    expected = (network.reconstruct(batch["latent_noise"], present) - steps).square().mean(-1)
    actual = VariationalLoss(network, reduction="none")(batch)["loss_reconstruction"]
    torch.testing.assert_close(actual, torch.where(recorded(batch), expected, 0.0))


def test_a_far_window_stays_finite():
    network, batch = make_network(), make_batch(6)
    batch["state"] *= 1e5
    losses = VariationalLoss(network)(batch)
    sum(losses.values()).backward()
    assert all(value.isfinite() for value in losses.values())
    assert all(value.grad is None or value.grad.isfinite().all() for value in network.parameters())


# labels


@pytest.mark.parametrize("train_encoder", [False, True])
def test_which_parts_the_action_trains(train_encoder):
    network = make_network()
    LatentDecoderLoss(network, train_encoder=train_encoder)(make_batch(6))["loss_action"].backward()
    reached = {name.split(".")[0] for name, value in network.named_parameters() if value.grad is not None}
    assert reached == {"action_decoder"} | ({"encoder"} if train_encoder else set())
    assert all((value.grad != 0).any() for value in network.parameters() if value.grad is not None)


@pytest.mark.parametrize("train_encoder", [False, True])
@pytest.mark.parametrize("poison", [1e30, torch.inf])
def test_hidden_actions_reach_neither_value_nor_gradient(train_encoder, poison):
    batch, results = make_batch(6), []
    for value in (0.0, poison, torch.nan):
        network, data = make_network(), batch.clone()
        data["action"] = torch.where(batch["has_action"], batch["action"], value)
        loss = LatentDecoderLoss(network, train_encoder=train_encoder)(data)["loss_action"]
        loss.backward()
        results.append([loss, *(p.grad for p in network.parameters() if p.grad is not None)])
    for result in results[1:]:
        for left, right in zip(results[0], result, strict=True):
            assert left.isfinite().all() and torch.equal(left, right)


def test_without_labels_loss_and_gradients_are_exactly_zero():
    network = make_network()
    loss = LatentDecoderLoss(network, train_encoder=True)(make_batch(6, share=0.0))["loss_action"]
    loss.backward()
    assert loss == 0
    assert all((value.grad == 0).all() for value in network.parameters() if value.grad is not None)


def test_no_label_is_read_in_the_first_stage():
    loss, batch = VariationalLoss(make_network()), make_batch(6)
    expected = loss(batch)
    bare = loss(batch.exclude("action", "has_action"))
    assert all(torch.equal(value, expected[key]) for key, value in bare.items())


# the controller


def test_actions_are_deterministic_decoded_means_in_raw_units():
    network, batch = make_network(), make_batch(2, 3)
    written = network(batch.select("state"))
    assert torch.equal(written["action"], network(batch.select("state"))["action"])
    mean, _ = network.posterior(network.read(batch["state"]))
    assert torch.equal(written["latent_action"], mean) and list(network.out_keys) == ["latent_action", "action"]
    raw = network.action_decoder(mean) * torch.tensor([0.5, 2.0]) + torch.tensor([0.3, 0.0])
    torch.testing.assert_close(written["action"], raw)
    torch.testing.assert_close(network.infer(batch["state"], SPAN), mean[..., SPAN.start : SPAN.stop, :])


def test_an_action_depends_on_the_frames_it_may_read_and_no_others():
    network, state = make_network(), torch.randn(1, T, 3, requires_grad=True)
    action = network(TensorDict({"state": state}, [1]))["action"]
    for t in range(T):
        (gradient,) = torch.autograd.grad(action[0, t].sum(), state, retain_graph=True)
        read = {min(max(t + offset, 0), T - 1) for offset in (-2, -1, 0, 1, 3)}
        assert set(gradient[0].abs().sum(-1).nonzero().flatten().tolist()) == read
    assert network.span(T) == SPAN and network.num_window_frames == 6 and network.num_past == 2
    with pytest.raises(ValueError, match="at least 6 frames are needed"):
        VariationalLoss(network)(TensorDict({"state": state[:, :5]}, [1]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_dimensions_types_keys_and_scales(dtype):
    network = make_network(in_key=("in", "x")).to(dtype)
    state = torch.randn(2, 4, T, 3, dtype=dtype) * torch.tensor([1.0, 1e-3, 10.0], dtype=dtype)
    network.fit_scales(state)
    _, steps = network.split(network.read(state, SPAN))
    torch.testing.assert_close(steps.square().mean((0, 1, 2)), torch.ones(12, dtype=dtype))
    action = network(TensorDict({"in": {"x": state}}, [2, 4]))["action"]
    assert action.shape == (2, 4, T, 2) and action.dtype == dtype
    network.set_keys(state="s", action=("out", "a"))
    assert network.in_keys == ["s"] and network.out_keys == ["latent_action", ("out", "a")]
    torch.testing.assert_close(network(TensorDict({"s": state[1, 3]}, []))["out", "a"], action[1, 3])
    other = make_network(seed=1).to(dtype)
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(TensorDict({"state": state}, [2, 4]))["action"], action)


def test_two_stages_learn_actions_from_few_labels():
    """x_{t+1} = 0.9 x_t + a_t: the labels of 32 windows suffice once the latent has been learnt from 1024."""
    generator = torch.Generator().manual_seed(0)
    action = torch.randn(1280, 12, 2, generator=generator)
    states = [torch.randn(1280, 2, generator=generator)]
    for t in range(11):
        states.append(0.9 * states[-1] + action[:, t])
    data = TensorDict({"state": torch.stack(states, 1), "action": action}, [1280])
    data["has_action"] = torch.zeros(1280, 12, 1, dtype=torch.bool)
    data["has_action"][:32] = True
    torch.manual_seed(0)
    network = VariationalInverseDynamics(2, 2, hidden_dims=(64, 64), num_past=1, look_ahead=(1, 2))
    network.fit_scales(data["state"][:1024])
    for loss, num_steps, rows in ((VariationalLoss(network), 400, 1024), (LatentDecoderLoss(network), 300, 32)):
        optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
        for _ in range(num_steps):
            batch = data[torch.randint(rows, (32,), generator=generator)]
            sum(loss(batch).values()).backward()
            optimizer.step()
            optimizer.zero_grad()
    unseen = data[1024:]
    error = (network(unseen.select("state"))["action"] - unseen["action"])[:, 1:10].square().mean()
    assert error < 0.05, error  # the mean action has error 1
