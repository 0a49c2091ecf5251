# This source code is licensed under the MIT license found in the LICENSE file.
"""Schedule and solvers: closed forms, and agreement with an independent implementation."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules.planning.noise_schedule import PREDICTIONS, SOLVERS, NoiseSchedule

DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()


def gaussian_network(schedule, mean, std):
    """The optimal network for data N(mean, std^2), known in closed form."""

    def network(x, time):
        signal, noise = (level[time.long()][..., None, None] for level in (schedule.signal, schedule.noise))
        sample = mean + signal * std**2 / (signal**2 * std**2 + noise**2) * (x - signal * mean)
        return schedule.target(sample, (x - signal * sample) / noise)

    return network


def smooth_network(x, time):
    return torch.sin(1.7 * x + 0.02 * time[..., None, None]) * 0.8


@pytest.mark.parametrize("steps", [20, 50, 1000])
def test_levels_preserve_variance_and_end_in_noise(steps):
    schedule = NoiseSchedule(num_train_steps=steps)
    torch.testing.assert_close(schedule.signal**2 + schedule.noise**2, torch.ones(steps))
    assert (schedule.signal.diff() < 0).all()
    assert schedule.signal[-1] < 0.02


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("device", DEVICES)
def test_target_and_split_are_inverse(prediction, dtype, device):
    schedule = NoiseSchedule(prediction).to(device)
    sample = torch.randn(5, 14, 2, dtype=dtype, device=device)
    noise = torch.randn_like(sample)
    for level in schedule.noise_levels(5)[:-1]:
        if level.signal < 0.05:  # next to pure noise the plan cannot be recovered to the last digit
            continue
        noisy = schedule.add_noise(sample, noise, sample.new_full((5,), level.time))
        got = schedule.split(schedule.target(sample, noise), noisy, level)
        torch.testing.assert_close(got, (sample, noise), atol=3e-5, rtol=0)
        assert noisy.dtype == dtype


def test_sampled_times_cover_the_schedule():
    generator = torch.Generator().manual_seed(0)
    times = NoiseSchedule(num_train_steps=20).sample_time(torch.empty(4000, 3, 2), generator)
    assert times.unique().tolist() == list(range(20))


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_recovers_a_gaussian(solver, prediction):
    schedule = NoiseSchedule(prediction, num_train_steps=1000)
    noise = torch.randn(5000, 1, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    plans = schedule.solve(gaussian_network(schedule, 0.7, 0.3), noise, 300, solver)
    assert plans.mean() == pytest.approx(0.7, abs=0.012)
    assert plans.std() == pytest.approx(0.3, rel=0.03)


def test_the_second_order_solver_is_more_accurate():
    schedule = NoiseSchedule(num_train_steps=1000)
    network = gaussian_network(schedule, 0.7, 0.3)
    noise = torch.randn(50, 4, 2, dtype=torch.float64)
    exact = schedule.solve(network, noise, 1000, "dpm++2m")
    coarse = {solver: schedule.solve(network, noise, 12, solver) for solver in SOLVERS}
    assert (coarse["dpm++2m"] - exact).abs().max() < 0.6 * (coarse["ddim"] - exact).abs().max()
    assert torch.equal(coarse["ddim"], schedule.solve(network, noise, 12, "ddim"))


def test_wrong_names_and_numbers_are_explained():
    with pytest.raises(ValueError, match="did you mean 'epsilon'"):
        NoiseSchedule("epsilonn")
    with pytest.raises(ValueError, match="num_train_steps must be at least 1, got 0"):
        NoiseSchedule(num_train_steps=0)
    noise = torch.randn(2, 3, 1)
    with pytest.raises(ValueError, match=r"did you mean 'dpm\+\+2m'"):
        NoiseSchedule().solve(smooth_network, noise, 5, "dpm2m")
    with pytest.raises(ValueError, match=r"num_steps must lie in 1..50 \(num_train_steps\), got 51"):
        NoiseSchedule().solve(smooth_network, noise, 51)
    with pytest.raises(ValueError, match="got 0"):
        NoiseSchedule().solve(smooth_network, noise, 0)


# ---- the oracle: diffusers, a test-only dependency


@pytest.fixture(scope="module")
def diffusers():
    return pytest.importorskip("diffusers", reason="the oracle 'diffusers' is in the extra 'dev'")


def oracle_options(prediction, steps):
    return {"num_train_timesteps": steps, "prediction_type": prediction, "beta_schedule": "squaredcos_cap_v2"}


def follow(scheduler, x, **options):
    for time in scheduler.timesteps:
        output = smooth_network(x, x.new_full(x.shape[:1], float(time)))
        x = scheduler.step(output, time, x, return_dict=False, **options)[0]
    return x


@pytest.mark.parametrize("prediction", PREDICTIONS)
def test_levels_agree_with_diffusers(diffusers, prediction):
    oracle = diffusers.DDPMScheduler(**oracle_options(prediction, 100))
    sample, noise, time = torch.randn(100, 4, 2), torch.randn(100, 4, 2), torch.arange(100)
    noisy = NoiseSchedule(prediction, num_train_steps=100).add_noise(sample, noise, time.float())
    torch.testing.assert_close(noisy, oracle.add_noise(sample, noise, time), atol=1e-5, rtol=0)


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("num_steps", [50, 10, 5])
def test_ddim_agrees_with_diffusers(diffusers, prediction, num_steps):
    oracle = diffusers.DDIMScheduler(**oracle_options(prediction, 50), clip_sample=False, timestep_spacing="trailing")
    oracle.set_timesteps(num_steps)
    noise = torch.randn(6, 14, 2, dtype=torch.float64)
    expected = follow(oracle, noise)
    got = NoiseSchedule(prediction).solve(smooth_network, noise, num_steps, "ddim")
    torch.testing.assert_close(got, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("num_steps", [20, 10, 5])
def test_dpm_solver_agrees_with_diffusers(diffusers, prediction, num_steps):
    oracle = diffusers.DPMSolverMultistepScheduler(
        **oracle_options(prediction, 50),
        algorithm_type="dpmsolver++",
        solver_order=2,
        solver_type="midpoint",
        final_sigmas_type="zero",
        lower_order_final=True,
        timestep_spacing="trailing",
    )
    oracle.set_timesteps(num_steps)
    noise = torch.randn(6, 14, 2, dtype=torch.float64)
    got = NoiseSchedule(prediction).solve(smooth_network, noise, num_steps, "dpm++2m")
    torch.testing.assert_close(got, follow(oracle, noise), atol=1e-4, rtol=1e-4)
