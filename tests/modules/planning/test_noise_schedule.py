# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests schedule and solvers against closed forms and an independent implementation."""

import pytest
import torch

from torchrl_koap.modules.planning.noise_schedule import NoiseSchedule


def smooth_network(x, time):
    return torch.sin(1.7 * x + 0.02 * time[..., None, None]) * 0.8


def test_every_step_of_the_noise_is_drawn():
    times = NoiseSchedule().sample_time(torch.empty(4000, 3, 2))
    assert times.unique().tolist() == list(range(50))


def test_wrong_names_and_numbers_are_explained():
    noise = torch.randn(2, 3, 1)
    with pytest.raises(ValueError, match=r"did you mean 'dpm\+\+2m'"):
        NoiseSchedule().solve(smooth_network, noise, 5, "dpm2m")
    with pytest.raises(ValueError, match=r"num_steps must lie in 1..50, the steps of training, got 51"):
        NoiseSchedule().solve(smooth_network, noise, 51)
    with pytest.raises(ValueError, match="got 0"):
        NoiseSchedule().solve(smooth_network, noise, 0)


# ---- the oracle: diffusers, a test-only dependency


@pytest.fixture(scope="module")
def diffusers():
    return pytest.importorskip("diffusers", reason="the oracle 'diffusers' is in the extra 'dev'")


OPTIONS = {"num_train_timesteps": 50, "prediction_type": "sample", "beta_schedule": "squaredcos_cap_v2"}


def follow(scheduler, x):
    for time in scheduler.timesteps:
        output = smooth_network(x, x.new_full(x.shape[:1], float(time)))
        x = scheduler.step(output, time, x, return_dict=False)[0]
    return x


def test_levels_agree_with_diffusers(diffusers):
    oracle = diffusers.DDPMScheduler(**OPTIONS)
    sample, noise, time = torch.randn(50, 4, 2), torch.randn(50, 4, 2), torch.arange(50)
    noisy = NoiseSchedule().add_noise(sample, noise, time.float())
    torch.testing.assert_close(noisy, oracle.add_noise(sample, noise, time), atol=1e-5, rtol=0)


DPM = {"algorithm_type": "dpmsolver++", "solver_order": 2, "solver_type": "midpoint", "final_sigmas_type": "zero"}
ORACLES = {
    "ddim": ("DDIMScheduler", {"clip_sample": False}),
    "dpm++2m": ("DPMSolverMultistepScheduler", DPM | {"lower_order_final": True}),
}


@pytest.mark.parametrize("num_steps", [50, 10, 5])
@pytest.mark.parametrize("solver", ORACLES)
def test_solvers_agree_with_diffusers(diffusers, solver, num_steps):
    name, options = ORACLES[solver]
    oracle = getattr(diffusers, name)(**OPTIONS, **options, timestep_spacing="trailing")
    oracle.set_timesteps(num_steps)
    noise = torch.randn(6, 14, 2, dtype=torch.float64)
    got = NoiseSchedule().solve(smooth_network, noise, num_steps, solver)
    torch.testing.assert_close(got, follow(oracle, noise), atol=1e-4, rtol=1e-4)
