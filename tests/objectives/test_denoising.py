# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the planner's loss: closed forms, compilation, and the tests of denoising losses."""

import pytest
import torch
from denoising_test_base import DenoisingLossTestBase, noised
from tensordict import TensorDict

from torchrl_koap.modules.planning.denoisers import MLPDenoiser
from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.unet import TemporalUnet
from torchrl_koap.objectives import PlannerLoss


def make_loss(dtype=torch.float32, seed=0, **options):
    torch.manual_seed(seed)
    denoiser = MLPDenoiser(2, 4, horizon=6, width=32)
    planner = StatePlanner(denoiser, state_dim=2, horizon=6)
    planner.fit_normalizers(windows(64))
    return PlannerLoss(planner.to(dtype), **options)


def windows(*batch, dtype=torch.float32):
    generator = torch.Generator().manual_seed(3)
    return torch.randn(*batch, 8, 2, generator=generator, dtype=dtype).cumsum(-2)


def batch_of(*batch, dtype=torch.float32):
    generator = torch.Generator().manual_seed(5)
    return TensorDict(
        {
            "state": windows(*batch, dtype=dtype),
            "planner_noise": torch.randn(*batch, 6, 2, generator=generator, dtype=dtype),
            "planner_time": torch.randint(1, 50, batch, generator=generator),
        },
        batch,
    )


class TestPlannerLoss(DenoisingLossTestBase):
    default_keys = {"state": "state", "noise": "planner_noise", "time": "planner_time"}
    in_names, out_keys = ("state",), ("loss_planner",)
    decrease = 0.5

    make_loss = staticmethod(make_loss)
    make_batch = staticmethod(batch_of)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_value_in_closed_form(dtype):
    loss = make_loss(dtype, reduction="none")
    data = batch_of(5, dtype=dtype)
    value = loss(data)["loss_planner"]

    planner, noise = loss.network, data["planner_noise"]
    state, time = data["state"], data["planner_time"].to(dtype)
    clean = state[:, 2:] - state[:, 1:2]
    clean = ((clean.flatten(1) - planner.plan_normalizer.offset) / planner.plan_normalizer.scale).reshape(5, 6, 2)
    condition = torch.cat([state[:, 0] - state[:, 1], state[:, 1]], -1)
    condition = (condition - planner.condition_normalizer.offset) / planner.condition_normalizer.scale
    with loss.network_params.to_module(planner):
        output = planner.denoiser(noised(planner, clean, noise, time), time, condition)
    torch.testing.assert_close(value, (output - clean) ** 2, atol=1e-4, rtol=1e-4)
    assert value.dtype == dtype


def test_statistics_fitted_after_the_loss_was_built_are_those_it_trains_with():
    loss, data = make_loss(), batch_of(5)
    loss.network.fit_normalizers(100 * windows(64))
    assert torch.equal(loss(data)["loss_planner"], PlannerLoss(loss.network)(data)["loss_planner"])


class LearnedFeatures(torch.nn.Linear):
    num_features = 3

    def forward(self, history):
        return super().forward(history.flatten(-2))


def test_features_and_an_encoder_before_the_planner_are_trained():
    planner = StatePlanner(TemporalUnet(2, 7, channels=(8,)), state_dim=2, horizon=6, features=LearnedFeatures(4, 3))
    encoder = torch.nn.Linear(2, 2)
    data = batch_of(5).update({"state": encoder(windows(5))})
    PlannerLoss(planner)(data)["loss_planner"].backward()
    assert planner.features.weight.grad.abs().max() > 0 and encoder.weight.grad.abs().max() > 0
    state = windows(5).requires_grad_()
    PlannerLoss(planner)(batch_of(5).update({"state": state}))["loss_planner"].backward()
    assert state.grad[:, :2].any() and not state.grad[:, 2:].any()  # the target does not move towards its prediction


class Narrow(torch.nn.Linear):
    def forward(self, sequence, time, condition):
        return super().forward(sequence)


def test_what_a_denoiser_returns_is_not_broadcast():
    with pytest.raises(ValueError, match=r"the denoiser must return \[5, 6, 2\], got \[5, 6, 1\]"):
        PlannerLoss(StatePlanner(Narrow(2, 1), state_dim=2, horizon=6))(batch_of(5))


@pytest.mark.parametrize(("entry", "shape"), [("planner_noise", (5, 6, 1)), ("planner_time", (5, 1))])
def test_given_noise_and_times_of_another_shape_are_refused(entry, shape):
    with pytest.raises(ValueError, match=rf"'{entry}' must be \[5.*\], got \{list(shape)}"):
        make_loss()(batch_of(5).set(entry, torch.ones(shape)))


def test_weights_scale_the_errors_of_their_columns():
    plain, weighted = make_loss(reduction="none"), make_loss(reduction="none", weights=torch.tensor([3.0, 1.0]))
    data = batch_of(5)
    scale = torch.tensor([1.5, 0.5])
    torch.testing.assert_close(weighted(data)["loss_planner"], scale * plain(data)["loss_planner"])
    for wrong in (torch.ones(3), torch.tensor([1.0, 0.0])):
        with pytest.raises(ValueError, match=r"weights must be \[2\] \[width\] and positive"):
            make_loss(weights=wrong)


@pytest.mark.parametrize("network", ["mlp", "unet"])
def test_forward_and_plan_compile_without_a_graph_break(network):
    torch._dynamo.reset()  # TorchRL wraps every loss in one function: their graphs share its recompilation limit
    loss = make_loss()
    if network == "unet":  # the loss of the other one is compiled in LossTestBase
        planner = StatePlanner(TemporalUnet(2, 4, channels=(8,)), state_dim=2, horizon=6, num_steps=2)
        loss, data = PlannerLoss(planner), batch_of(4)
        compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")
        torch.testing.assert_close(compiled(data)["loss_planner"], loss(data)["loss_planner"])
    plan = torch.compile(loss.network.sample, fullgraph=True, backend="aot_eager")
    history, noise = windows(4)[:, :2], torch.randn(4, 6, 2)
    with torch.no_grad():
        torch.testing.assert_close(plan(history, noise), loss.network.sample(history, noise))


def test_half_precision_products_leave_weights_and_gradients_in_float32():
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=32), state_dim=2)
    windows = TensorDict({"state": torch.randn(64, 16, 2)}, [64])
    windows["planner_noise"], windows["planner_time"] = torch.randn(64, 14, 2), torch.full((64,), 20.0)
    exact = PlannerLoss(planner)(windows)["loss_planner"]
    loss = PlannerLoss(planner, dtype=torch.bfloat16)
    rounded = loss(windows)["loss_planner"]
    assert rounded.dtype == torch.float32
    assert rounded.item() != exact.item() and rounded.item() == pytest.approx(exact.item(), rel=0.01)
    rounded.backward()
    gradients = [parameter.grad for parameter in loss.parameters() if parameter.grad is not None]
    assert gradients and all(gradient.dtype == torch.float32 and gradient.isfinite().all() for gradient in gradients)
