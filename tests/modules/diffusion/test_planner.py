# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner as a module: coordinates, keys, noise, exploration types."""

from __future__ import annotations

import copy

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_koap.modules.diffusion.denoisers import MLPDenoiser
from torchrl_koap.modules.diffusion.noise_schedule import NoiseSchedule
from torchrl_koap.modules.diffusion.planner import StatePlanner
from torchrl_koap.modules.diffusion.unet import TemporalUnet

DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()


def make_planner(**options):
    torch.manual_seed(0)
    denoiser = MLPDenoiser(2, 2 * options.get("history", 2), horizon=options.get("horizon", 14), width=16, depth=1)
    return StatePlanner(denoiser, state_dim=2, **options)


def walks(number, length=16, dtype=torch.float32):
    generator = torch.Generator().manual_seed(3)
    return (0.01 * torch.randn(number, length, 2, generator=generator, dtype=dtype)).cumsum(1)


class Bimodal(nn.Module):
    """The optimal prediction of the clean plan if it is -1 or +1 with equal chances."""

    def __init__(self, schedule):
        super().__init__()
        self.schedule = schedule

    def forward(self, x, time, condition):
        signal, noise = (level[time.long()][..., None, None] for level in (self.schedule.signal, self.schedule.noise))
        return torch.tanh(signal * x / noise**2)


@pytest.mark.parametrize("relative", [True, False])
@pytest.mark.parametrize("mode", ["minmax", "standard", "identity"])
def test_decode_inverts_encode(relative, mode):
    planner = make_planner(relative=relative)
    windows = walks(50)
    planner.fit_normalizers(windows, mode=mode)
    history, plan = planner.split_window(windows)
    encoded = planner.encode_plan(history, plan)
    torch.testing.assert_close(planner.decode_plan(history, encoded), plan, atol=1e-6, rtol=0)
    if mode == "minmax":
        assert encoded.abs().max() == pytest.approx(1, abs=1e-5)
        assert planner.encode_history(history).abs().max() == pytest.approx(1, abs=1e-5)
        assert (encoded.abs().amax((0, 2)) > 0.99).all()
    if mode == "standard":
        torch.testing.assert_close(encoded.std(0, correction=0), torch.ones(14, 2), atol=1e-4, rtol=0)


def test_relative_coordinates_do_not_move_with_the_data():
    planner = make_planner()
    history, plan = planner.split_window(walks(4))
    shifted = torch.tensor([0.3, -0.2])
    torch.testing.assert_close(
        planner.encode_plan(history, plan), planner.encode_plan(history + shifted, plan + shifted)
    )
    condition = planner.encode_history(history)
    torch.testing.assert_close(condition[:, :2], history[:, 0] - history[:, 1])
    torch.testing.assert_close(condition[:, 2:], history[:, 1])


@pytest.mark.parametrize("exploration", [ExplorationType.DETERMINISTIC, ExplorationType.RANDOM, None])
def test_both_modes_of_a_bimodal_future_appear(exploration):
    noise_schedule = NoiseSchedule(num_train_steps=200)
    planner = StatePlanner(
        Bimodal(noise_schedule), noise_schedule, state_dim=1, history=1, horizon=1, relative=False, num_steps=40
    )
    torch.manual_seed(0)
    history = torch.zeros(600, 1, 1)
    if exploration is None:
        plans = planner.plan(history)
    else:
        with set_exploration_type(exploration):
            plans = planner.plan(history)
    torch.testing.assert_close(plans.abs(), torch.ones_like(plans), atol=0.02, rtol=0)
    assert 0.42 < (plans > 0).float().mean() < 0.58


def test_given_noise_makes_plans_independent_of_the_batch():
    planner = make_planner(num_steps=5, clip=1.0)
    history, noise = torch.randn(6, 2, 2), torch.randn(6, 14, 2)
    together = planner(TensorDict({"history": history, "noise": noise}, [6]))["plan"]
    for row in range(6):
        torch.testing.assert_close(planner.plan(history[row], noise[row]), together[row], atol=1e-5, rtol=1e-4)


def test_a_generator_repeats_plans():
    planner = make_planner(num_steps=10, clip=1.0)
    history = torch.randn(3, 2, 2)
    first, second, other = (planner.plan(history, generator=torch.Generator().manual_seed(s)) for s in (0, 0, 1))
    assert torch.equal(first, second) and not torch.equal(first, other)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (1,), (3,), (2, 3)])
def test_any_batch_dtype_and_device(batch, dtype, device):
    planner = StatePlanner(TemporalUnet(2, 4, channels=(16,)), state_dim=2, num_steps=3, clip=1.0)
    planner.fit_normalizers(walks(20, dtype=torch.float64))
    planner.to(device=device, dtype=dtype)
    history = torch.randn(*batch, 2, 2, dtype=dtype, device=device)
    noise = planner.draw_noise(history)
    plan = planner(TensorDict({"history": history, "noise": noise}, batch))["plan"]
    assert plan.shape == (*batch, 14, 2) and plan.dtype == dtype and plan.isfinite().all()
    flat = planner.plan(history.reshape(-1, 2, 2), noise.reshape(-1, 14, 2))
    torch.testing.assert_close(plan.reshape(-1, 14, 2), flat)


def test_keys_can_be_renamed_and_the_call_dispatched():
    planner = make_planner(
        in_keys=[("agent", "past")], out_keys=[("agent", "future")], noise_key=("agent", "luck"), num_steps=3
    )
    history, noise = torch.randn(3, 2, 2), torch.randn(3, 14, 2)
    data = TensorDict({"agent": {"past": history, "luck": noise}}, [3])
    planner(data)
    expected = planner.plan(history, noise)
    torch.testing.assert_close(data["agent", "future"], expected)
    plain = make_planner(num_steps=3)
    assert plain(history=history).shape == (3, 14, 2)
    plain.set_keys(history="past", plan="future")
    data = plain(TensorDict({"past": history, "noise": noise}, [3]))
    torch.testing.assert_close(data["future"], expected)


def test_statistics_travel_in_the_state_dict():
    planner = make_planner(num_steps=3)
    planner.fit_normalizers(walks(30))
    fresh = make_planner(num_steps=3)
    fresh.load_state_dict(planner.state_dict())
    history, noise = walks(5)[:, :2], torch.randn(5, 14, 2)
    torch.testing.assert_close(fresh.plan(history, noise), planner.plan(history, noise))
    torch.testing.assert_close(copy.deepcopy(planner).plan(history, noise), planner.plan(history, noise))


def test_solver_and_steps_can_be_set_and_are_checked():
    planner = make_planner()
    assert planner.solver == "dpm++2m"
    planner.solver, planner.num_steps = "ddim", 50
    with pytest.raises(ValueError, match="did you mean 'ddim'"):
        planner.solver = "dim"
    with pytest.raises(ValueError, match="num_steps must lie in 1..50"):
        planner.num_steps = 60
    assert planner.solver == "ddim" and planner.num_steps == 50


def test_wrong_shapes_are_explained():
    planner = make_planner(num_steps=3)
    for length in (1, 3):
        with pytest.raises(ValueError, match=rf"'history' must be \[\*B, 2, 2\].* got \[5, {length}, 2\]"):
            planner(TensorDict({"history": torch.zeros(5, length, 2)}, [5]))
    with pytest.raises(ValueError, match=r"'noise' must be \[5, 14, 2\].* got \[5, 12, 2\]"):
        planner.plan(torch.zeros(5, 2, 2), torch.zeros(5, 12, 2))
    with pytest.raises(
        ValueError, match=r"windows must be \[\*B, 16, 2\] \(history \+ horizon, state_dim\), got \[4, 15, 2\]"
    ):
        planner.fit_normalizers(torch.zeros(4, 15, 2))
    with pytest.raises(ValueError, match="horizon must be at least 1"):
        make_planner(horizon=0)
    with pytest.raises(ValueError, match="one in_key and one out_key"):
        make_planner(in_keys=["a", "b"])
