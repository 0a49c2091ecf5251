# This source code is licensed under the MIT license found in the LICENSE file.
"""The controller with quantised latents: codes, plain loops, what may reach what, learning in two stages."""

from __future__ import annotations

import math

import pytest
import torch
from inverse_dynamics_test_base import (
    ACTION,
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
from tensordict import TensorDict

from torchrl_koap.modules import FiniteScalarQuantizer, QuantizedInverseDynamics
from torchrl_koap.objectives import ActionLoss, QuantizedDynamicsLoss

SPAN = range(2, 6)
LEVELS = [(8, 5, 5, 5), (3, 4), (6,), (5, 3, 8)]


def make_network(seed=0, **options):
    torch.manual_seed(seed)
    sizes = {"latent_dim": 6, "hidden_dims": (16,), "num_past": 2, "look_ahead": (1, 3)}
    return QuantizedInverseDynamics(3, 2, **sizes, **normalizers(), **options)


class TestQuantizedInverseDynamics(InverseDynamicsTestBase):
    reads = (-2, -1, 0, 1, 3)

    def make_network(self, seed=0, **options):
        return make_network(seed, **options)


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


def test_the_forward_model_sees_the_next_state_through_the_code_alone():
    network, state = make_network(), torch.randn(1, T, 3, requires_grad=True)
    network.quantizer.forward = torch.zeros_like
    predicted, step = network.predict_step(state, SPAN)
    (gradient,) = torch.autograd.grad(predicted[0, 1].sum(), state, retain_graph=True)  # frame 3
    assert gradient[0].abs().sum(-1).nonzero().flatten().tolist() == [1, 2, 3]
    (gradient,) = torch.autograd.grad(step[0, 1].sum(), state)
    assert gradient[0].abs().sum(-1).nonzero().flatten().tolist() == [3, 4]


def test_each_stage_trains_what_it_should():
    network, batch = make_network(), partly_labelled(6)
    dynamics = QuantizedDynamicsLoss(network)(batch)["loss_dynamics"]
    assert reached(network, dynamics) == {"encoder", "quantizer", "dynamics"}
    action = ActionLoss(network, freeze_latents=True)(batch)["loss_action"]
    assert reached(network, action) == {"action_decoder"}
    assert reached(network, ActionLoss(network)(batch)["loss_action"]) == {"action_decoder", "encoder", "quantizer"}


def test_an_action_is_a_function_of_the_code_alone():
    """Two frames with one code have one action, whatever their states; few levels make such pairs."""
    network = make_network()
    network.quantizer = FiniteScalarQuantizer(6, levels=(3,))
    state = 5 * torch.randn(30, T, 3, generator=torch.Generator().manual_seed(2))
    written = network(TensorDict({"state": state}, [30]))
    action, latent = written["action"].flatten(0, 1), written["latent_action"].flatten(0, 1)
    codes, member = (latent * 1e4).round().unique(dim=0, return_inverse=True)
    assert 3 <= len(codes) <= 9
    for code in range(len(codes)):
        same = action[member == code]
        torch.testing.assert_close(same, same[:1].expand_as(same))


def test_look_ahead_must_hold_the_transition():
    with pytest.raises(ValueError, match=r"look_ahead must contain 1, .* got \(2, 3\)"):
        QuantizedInverseDynamics(3, 2, look_ahead=(2, 3))


def test_two_stages_learn_actions_from_few_labels():
    data = few_labels()
    torch.manual_seed(0)
    network = QuantizedInverseDynamics(2, 2, hidden_dims=(64, 64), num_past=1, look_ahead=(1, 2))
    network.prepare(data["state"][:1024])
    unseen = data[1024:]
    train(
        network,
        data,
        (QuantizedDynamicsLoss(network), 200, 1024),
        (ActionLoss(network, freeze_latents=True), 200, 32),
    )
    error = QuantizedDynamicsLoss(network)(unseen)["loss_dynamics"]
    assert error < 0.1, error  # without a code 0.97 is the best, that of -0.1 x_t
    used = (network.infer(unseen["state"]).flatten(0, 1) * 1e4).round().unique(dim=0)
    assert len(used) > 100, len(used)  # the codes have not collapsed
    error = (network(unseen.select("state"))["action"] - unseen["action"])[:, 1:10].square().mean()
    assert error < 0.1, error  # the mean action has error 1


class TestFiniteScalarQuantizer:
    @pytest.mark.parametrize("levels", LEVELS)
    def test_every_level_is_reached_and_no_other(self, levels):
        quantizer = FiniteScalarQuantizer(7, levels=levels, num_codebooks=1).double()
        grid = torch.linspace(-9, 9, 4001, dtype=torch.float64)[:, None].expand(-1, len(levels))
        codes = quantizer.quantize(grid)
        for column, count in enumerate(levels):
            half = count // 2
            expected = torch.arange(-half, count - half, dtype=torch.float64) / half
            assert torch.equal(codes[:, column].unique(), expected)
            assert (codes[1:, column] >= codes[:-1, column]).all()
        assert codes.abs().max() == 1

    @pytest.mark.parametrize("levels", LEVELS)
    def test_there_are_as_many_codes_as_the_product_of_the_levels(self, levels):
        quantizer = FiniteScalarQuantizer(7, levels=levels, num_codebooks=1)
        values = 5 * torch.rand(60_000, len(levels), generator=torch.Generator().manual_seed(0)) - 2.5
        assert len(quantizer.quantize(values).unique(dim=0)) == math.prod(levels)  # equal codes: bit for bit

    def test_zero_is_the_code_zero_and_in_the_middle_of_its_level(self):
        quantizer = FiniteScalarQuantizer(7, num_codebooks=1).double()
        zero = torch.zeros(4, dtype=torch.float64)
        torch.testing.assert_close(quantizer.bound(zero), zero, atol=1e-15, rtol=0)
        assert (quantizer.quantize(zero) == 0).all()

    def test_a_code_is_never_further_from_its_value_than_half_a_level(self):
        quantizer = FiniteScalarQuantizer(7).double()
        values = 5 * torch.rand(5000, 8, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 2.5
        rounded = quantizer.quantize(values) * torch.tensor([number // 2 for number in quantizer.levels])
        assert (rounded - quantizer.bound(values)).abs().max() <= 0.5
        assert quantizer.quantize(torch.full((8,), 1e9)).isfinite().all()

    def test_gradients_are_those_of_the_bounded_value(self):
        quantizer = FiniteScalarQuantizer(7, num_codebooks=1).double()
        values = (5 * torch.rand(50, 4, dtype=torch.float64) - 2.5).requires_grad_()
        (straight,) = torch.autograd.grad(quantizer.quantize(values).sum(), values)
        levels = torch.tensor([8.0, 5.0, 5.0, 5.0], dtype=torch.float64)
        half_range, shift = (levels - 1) / 2, torch.tensor([math.atanh(0.5 / 3.5), 0, 0, 0], dtype=torch.float64)
        expected = half_range / (levels // 2) * (1 - torch.tanh(values.detach() + shift) ** 2)
        torch.testing.assert_close(straight, expected)
        quantizer(torch.randn(5, 7, dtype=torch.float64)).sum().backward()
        assert all(value.grad.isfinite().all() and (value.grad != 0).any() for value in quantizer.parameters())

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"levels": (8, 2)}, r"3 levels or more, got levels \(8, 2\)"),
            ({"levels": ()}, "3 levels or more"),
            ({"num_codebooks": 0}, "num_codebooks must be >= 1, got 0"),
        ],
    )
    def test_what_cannot_be_a_code_is_refused(self, options, message):
        with pytest.raises(ValueError, match=message):
            FiniteScalarQuantizer(16, **options)
