# This source code is licensed under the MIT license found in the LICENSE file.
"""The controller with quantised latents and its losses: plain loops, what may reach what, learning in two stages."""

from __future__ import annotations

import pytest
import torch
from loss_test_base import LossTestBase
from tensordict import TensorDict

from torchrl_koap.modules import Normalizer, QuantizedInverseDynamics
from torchrl_koap.objectives import LatentDecoderLoss, QuantizedDynamicsLoss

T, HISTORY, LOOK_AHEAD = 9, 2, (1, 3)
SPAN = range(2, 6)
KEYS = {"state": "state", "action": "action", "has_action": "has_action", "padded": "padded"}


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    return QuantizedInverseDynamics(
        3,
        2,
        latent_dim=6,
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
    state = 2 * torch.randn(*batch, T, 3, generator=generator)
    return TensorDict({"state": state, "action": action, "has_action": has_action, "padded": padded}, batch)


def recorded(batch):
    frames = slice(SPAN.start, SPAN.stop)
    return ~(batch["padded"][..., frames] | batch["padded"][..., SPAN.start + 1 : SPAN.stop + 1])


class TestQuantizedDynamicsLoss(LossTestBase):
    default_keys = KEYS
    in_names, out_keys = ("state",), ("loss_dynamics",)
    learning_rate = 1e-2

    def make_loss(self, seed=0, **options):
        return QuantizedDynamicsLoss(make_network(seed), **options)

    def make_batch(self, *batch):
        return make_batch(*batch)

    def counted(self, batch, key, elements):
        assert (elements[~recorded(batch)] == 0).all() and (elements[recorded(batch)] > 0).all()
        return int(recorded(batch).sum())


class TestLatentDecoderLoss(LossTestBase):
    default_keys = KEYS
    in_names, out_keys = ("state", "action", "has_action"), ("loss_action",)
    learning_rate, decrease = 1e-2, 0.9
    test_compiled_equals_eager = None  # test_variational compiles the same loss, TestQuantizedDynamicsLoss this network

    def make_loss(self, seed=0, **options):
        return LatentDecoderLoss(make_network(seed), **options)

    def make_batch(self, *batch):
        return make_batch(*batch)

    def counted(self, batch, key, elements):
        return int((recorded(batch) & batch["has_action"][..., SPAN.start : SPAN.stop, 0]).sum())


# values


def test_values_in_plain_loops():
    network, batch = make_network(), make_batch(6)
    scales = torch.rand(5, 3, generator=torch.Generator().manual_seed(1)) + 0.5
    scales[HISTORY] = 1.0
    network.reader.scales.copy_(scales)
    offset, scale = network.state_normalizer.offset, network.state_normalizer.scale
    dynamics, action = [], []
    for window in range(6):
        x = (batch["state"][window] - offset) / scale
        for t in SPAN:
            if batch["padded"][window, t] or batch["padded"][window, t + 1]:
                continue
            past = [(x[t - 1] - x[t - 2]) / scales[0], (x[t] - x[t - 1]) / scales[1], x[t]]
            step = (x[t + 1] - x[t]) / scales[3]
            latent = network.quantizer(network.encoder(torch.cat([*past, step, (x[t + 3] - x[t + 1]) / scales[4]])))
            dynamics.append(((network.dynamics(torch.cat([*past, latent])) - step) ** 2).mean())
            if batch["has_action"][window, t]:
                target = (batch["action"][window, t] - torch.tensor([0.3, 0.0])) / torch.tensor([0.5, 2.0])
                action.append(((network.action_decoder(latent) - target) ** 2).mean())
    assert 5 < len(action) < len(dynamics) < 6 * len(SPAN)
    torch.testing.assert_close(QuantizedDynamicsLoss(network)(batch)["loss_dynamics"], torch.stack(dynamics).mean())
    torch.testing.assert_close(LatentDecoderLoss(network)(batch)["loss_action"], torch.stack(action).mean())


def test_the_forward_model_sees_the_next_state_through_the_code_alone():
    network, state = make_network(), torch.randn(1, T, 3, requires_grad=True)
    past, step = network.split(network.read(state, SPAN))
    (gradient,) = torch.autograd.grad(past[0, 1].sum(), state, retain_graph=True)  # frame 3
    assert gradient[0].abs().sum(-1).nonzero().flatten().tolist() == [1, 3]  # x_2 cancels in the sum of the steps
    (gradient,) = torch.autograd.grad(step[0, 1].sum(), state)
    assert gradient[0].abs().sum(-1).nonzero().flatten().tolist() == [3, 4]


# labels


@pytest.mark.parametrize("train_encoder", [False, True])
def test_which_parts_the_action_trains(train_encoder):
    network = make_network()
    LatentDecoderLoss(network, train_encoder=train_encoder)(make_batch(6))["loss_action"].backward()
    reached = {name.split(".")[0] for name, value in network.named_parameters() if value.grad is not None}
    assert reached == {"action_decoder"} | ({"encoder", "quantizer"} if train_encoder else set())
    assert all((value.grad != 0).any() for value in network.parameters() if value.grad is not None)


def test_the_first_stage_trains_all_but_the_action_decoder_and_reads_no_label():
    network, batch = make_network(), make_batch(6)
    QuantizedDynamicsLoss(network)(batch.exclude("action", "has_action"))["loss_dynamics"].backward()
    reached = {name.split(".")[0] for name, value in network.named_parameters() if value.grad is not None}
    assert reached == {"encoder", "quantizer", "dynamics"}


def test_hidden_actions_reach_neither_value_nor_gradient():
    batch, results = make_batch(6), []
    for value in (0.0, 1e30, torch.nan):
        network, data = make_network(), batch.clone()
        data["action"] = torch.where(batch["has_action"], batch["action"], value)
        loss = LatentDecoderLoss(network, train_encoder=True)(data)["loss_action"]
        loss.backward()
        results.append([loss, *(p.grad for p in network.parameters() if p.grad is not None)])
    for result in results[1:]:
        for left, right in zip(results[0], result, strict=True):
            assert left.isfinite().all() and torch.equal(left, right)


# the controller


def test_an_action_is_a_function_of_the_code_alone():
    """Two frames with one code have one action, whatever their states; few levels make such pairs."""
    network = make_network(levels=(3,), num_codebooks=2)
    state = 5 * torch.randn(30, T, 3, generator=torch.Generator().manual_seed(2))
    action = network(TensorDict({"state": state}, [30]))["action"].flatten(0, 1)
    indices = network.code_indices(state).flatten(0, 1)
    assert indices.shape == (30 * T, 2) and indices.max() < 3
    codes, member = indices.unique(dim=0, return_inverse=True)
    assert 3 <= len(codes) <= 9
    for code in range(len(codes)):
        same = action[member == code]
        torch.testing.assert_close(same, same[:1].expand_as(same))


def test_look_ahead_must_hold_the_transition():
    with pytest.raises(ValueError, match=r"look_ahead must contain 1, .* got \(2, 3\)"):
        QuantizedInverseDynamics(3, 2, look_ahead=(2, 3))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_batch_dimensions_types_keys_units_and_state_dict(dtype):
    network = make_network(out_key=("out", "a")).to(dtype)
    state = torch.randn(2, 4, T, 3, dtype=dtype)
    network.fit_scales(state)
    _, step = network.split(network.read(state, SPAN))
    torch.testing.assert_close(step.square().mean((0, 1, 2)), torch.ones(3, dtype=dtype))
    written = network(TensorDict({"state": state}, [2, 4]))
    action, latent = written["out", "a"], written["latent_action"]
    assert action.shape == (2, 4, T, 2) and action.dtype == dtype and latent.shape == (2, 4, T, 6)
    scale, offset = torch.tensor([0.5, 2.0]).to(dtype), torch.tensor([0.3, 0.0]).to(dtype)
    torch.testing.assert_close(action, network.decode(latent) * scale + offset)
    network.set_keys(state="s", action="b")
    assert network.in_keys == ["s"] and network.out_keys == ["latent_action", "b"]
    torch.testing.assert_close(network(TensorDict({"s": state[1, 3]}, []))["b"], action[1, 3])
    other = make_network(seed=1).to(dtype)
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(TensorDict({"state": state}, [2, 4]))["action"], action)


def test_two_stages_learn_actions_from_few_labels():
    """x_{t+1} = 0.9 x_t + a_t: the labels of 32 windows suffice once the codes have been learnt from 1024."""
    generator = torch.Generator().manual_seed(0)
    action = torch.randn(1280, 12, 2, generator=generator)
    states = [torch.randn(1280, 2, generator=generator)]
    for t in range(11):
        states.append(0.9 * states[-1] + action[:, t])
    data = TensorDict({"state": torch.stack(states, 1), "action": action}, [1280])
    data["has_action"] = torch.zeros(1280, 12, 1, dtype=torch.bool)
    data["has_action"][:32] = True
    torch.manual_seed(0)
    network = QuantizedInverseDynamics(2, 2, hidden_dims=(64, 64), num_past=1, look_ahead=(1, 2))
    network.fit_scales(data["state"][:1024])
    unseen = data[1024:]
    for loss, num_steps, rows in ((QuantizedDynamicsLoss(network), 400, 1024), (LatentDecoderLoss(network), 300, 32)):
        optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
        for _ in range(num_steps):
            batch = data[torch.randint(rows, (32,), generator=generator)]
            sum(loss(batch).values()).backward()
            optimizer.step()
            optimizer.zero_grad()
    error = QuantizedDynamicsLoss(network)(unseen)["loss_dynamics"]
    assert error < 0.1, error  # without a code 0.97 is the best, that of -0.1 x_t
    used = network.code_indices(unseen["state"]).flatten(0, 1).unique(dim=0)
    assert len(used) > 100, len(used)  # the codes have not collapsed
    error = (network(unseen.select("state"))["action"] - unseen["action"])[:, 1:10].square().mean()
    assert error < 0.1, error  # the mean action has error 1
