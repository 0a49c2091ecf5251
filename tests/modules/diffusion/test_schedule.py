# This source code is licensed under the MIT license found in the LICENSE file.
"""Schedules and solvers: closed forms, and agreement with an independent implementation."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.modules.diffusion.schedule import PREDICTIONS, SCHEDULES, NoiseSchedule
from torchrl_koap.modules.diffusion.solvers import SOLVERS

DIFFUSION = [name for name, schedule in SCHEDULES.items() if schedule.path == "diffusion"]
FITTING = [(s, v) for s in SCHEDULES for v in SOLVERS if SCHEDULES[s].path == SOLVERS[v].path]
DEVICES = ["cpu"] + ["cuda"] * torch.cuda.is_available()
VALID = [(s, p) for s in SCHEDULES for p in PREDICTIONS if (s, p) != ("flow", "epsilon")]


def gaussian_network(schedule, mean, std):
    """The optimal network for data N(mean, std^2), known in closed form."""

    def network(x, time):
        signal, noise = (level[..., None, None] for level in schedule.levels(time))
        sample = mean + signal * std**2 / (signal**2 * std**2 + noise**2) * (x - signal * mean)
        epsilon = (x - signal * sample) / noise
        return schedule.target(sample, epsilon, time)

    return network


def smooth_network(x, time):
    return torch.sin(1.7 * x + 0.02 * time[..., None, None]) * 0.8


@pytest.mark.parametrize("name", DIFFUSION)
@pytest.mark.parametrize("steps", [20, 50, 1000])
def test_diffusion_levels_preserve_variance_and_end_in_noise(name, steps):
    schedule = NoiseSchedule(name, num_train_steps=steps)
    torch.testing.assert_close(schedule.signal**2 + schedule.noise**2, torch.ones(steps))
    assert (schedule.signal.diff() < 0).all()
    assert schedule.signal[-1] < 0.02


def test_flow_levels_are_straight():
    schedule = NoiseSchedule("flow", num_train_steps=10)
    signal, noise = schedule.levels(torch.tensor([0.0, 2.5, 10.0]))
    torch.testing.assert_close(signal, torch.tensor([1.0, 0.75, 0.0]))
    torch.testing.assert_close(noise, torch.tensor([0.0, 0.25, 1.0]))


@pytest.mark.parametrize(("name", "prediction"), VALID)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("device", DEVICES)
def test_target_and_split_are_inverse(name, prediction, dtype, device):
    schedule = NoiseSchedule(name, prediction).to(device)
    sample = torch.randn(5, 14, 2, dtype=dtype, device=device)
    noise = torch.randn_like(sample)
    for node in schedule.nodes(5)[:-1]:
        if node.signal < 0.05:  # next to pure noise the plan cannot be recovered to the last digit
            continue
        time = sample.new_full((5,), node.time)
        noisy = schedule.add_noise(sample, noise, time)
        got = schedule.split(schedule.target(sample, noise, time), noisy, node)
        torch.testing.assert_close(got, (sample, noise), atol=3e-5, rtol=0)
        assert noisy.dtype == dtype


@pytest.mark.parametrize(("name", "prediction"), VALID)
def test_clip_bounds_the_plan_and_keeps_the_split_consistent(name, prediction):
    schedule = NoiseSchedule(name, prediction)
    node, x = schedule.nodes(4)[1], 5 * torch.randn(6, 3, 2)
    sample, epsilon = schedule.split(torch.randn_like(x), x, node, clip=0.5)
    assert sample.abs().max() <= 0.5
    torch.testing.assert_close(node.signal * sample + node.noise * epsilon, x)


def test_sampled_times_cover_the_schedule():
    generator = torch.Generator().manual_seed(0)
    like = torch.empty(4000, 3, 2)
    times = NoiseSchedule("linear", num_train_steps=20).sample_time(like, generator)
    assert times.unique().tolist() == list(range(20))
    times = NoiseSchedule("flow", num_train_steps=20).sample_time(like, generator)
    assert 0 < times.min() < 0.1 and 19.9 < times.max() <= 20
    assert abs(times.mean() - 10) < 0.3


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize(("name", "solver"), FITTING)
def test_every_solver_recovers_a_gaussian(name, solver, prediction):
    if (name, prediction) == ("flow", "epsilon"):
        pytest.skip("undefined on a flow path (tested below)")
    schedule = NoiseSchedule(name, prediction, num_train_steps=1000)
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(5000, 1, 2, generator=generator, dtype=torch.float64)
    steps = 1000 if solver == "ddpm" else 300  # ancestral sampling converges slowest
    plans = schedule.solve(gaussian_network(schedule, 0.7, 0.3), noise, steps, solver, generator=generator)
    assert plans.mean() == pytest.approx(0.7, abs=0.012)
    assert plans.std() == pytest.approx(0.3, rel=0.03)


@pytest.mark.parametrize(
    ("first", "second", "name"), [("ddim", "dpm++2m", "squared_cosine"), ("euler", "heun", "flow")]
)
def test_second_order_solvers_are_more_accurate(first, second, name):
    schedule = NoiseSchedule(name, "velocity", num_train_steps=1000)
    network = gaussian_network(schedule, 0.7, 0.3)
    noise = torch.randn(50, 4, 2, dtype=torch.float64)
    exact = schedule.solve(network, noise, 1000, second)
    coarse = {solver: schedule.solve(network, noise, 12, solver) for solver in (first, second)}
    assert (coarse[second] - exact).abs().max() < 0.6 * (coarse[first] - exact).abs().max()


def test_steps_of_a_deterministic_solver_need_no_generator_and_ancestral_draws_can_be_given():
    schedule = NoiseSchedule()
    noise, draws = torch.randn(3, 4, 2), torch.randn(50, 3, 4, 2)
    once = schedule.solve(smooth_network, noise, 50, "ddpm", step_noise=draws, clip=1.0)
    assert torch.equal(once, schedule.solve(smooth_network, noise, 50, "ddpm", step_noise=draws, clip=1.0))
    drawn = [
        schedule.solve(smooth_network, noise, 50, "ddpm", generator=torch.Generator().manual_seed(seed), clip=1.0)
        for seed in (0, 0, 1)
    ]
    assert torch.equal(drawn[0], drawn[1]) and not torch.equal(drawn[0], drawn[2])
    assert torch.equal(schedule.solve(smooth_network, noise, 9), schedule.solve(smooth_network, noise, 9))


def test_wrong_names_and_numbers_are_explained():
    with pytest.raises(ValueError, match="did you mean 'squared_cosine'"):
        NoiseSchedule("squared_cosin")
    with pytest.raises(ValueError, match="did you mean 'velocity'"):
        NoiseSchedule(prediction="velocty")
    with pytest.raises(ValueError, match="'epsilon' does not fit schedule 'flow'"):
        NoiseSchedule("flow", "epsilon")
    noise = torch.randn(2, 3, 1)
    with pytest.raises(ValueError, match=r"did you mean 'dpm\+\+2m'"):
        NoiseSchedule().solve(smooth_network, noise, 5, "dpm2m")
    with pytest.raises(ValueError, match="solvers that fit: 'ddpm', 'ddim', 'dpm"):
        NoiseSchedule().solve(smooth_network, noise, 5, "euler")
    with pytest.raises(ValueError, match="solvers that fit: 'euler', 'heun'"):
        NoiseSchedule("flow").solve(smooth_network, noise, 5, "ddim")
    with pytest.raises(ValueError, match=r"num_steps must lie in 1..50 \(num_train_steps\), got 51"):
        NoiseSchedule().solve(smooth_network, noise, 51)
    with pytest.raises(ValueError, match="got 0"):
        NoiseSchedule("flow").solve(smooth_network, noise, 0, "euler")


# ---- the oracle: diffusers, a test-only dependency


@pytest.fixture(scope="module")
def diffusers():
    return pytest.importorskip("diffusers", reason="the oracle 'diffusers' is in the extra 'dev'")


KIND = {"epsilon": "epsilon", "sample": "sample", "velocity": "v_prediction"}
BETAS = {"squared_cosine": {"beta_schedule": "squaredcos_cap_v2"}, "linear": {"beta_schedule": "linear"}}


def oracle_options(name, prediction, steps):
    options = {"num_train_timesteps": steps, "prediction_type": KIND[prediction], **BETAS[name]}
    if name == "linear":
        options |= {"beta_start": 0.1 / steps, "beta_end": 20 / steps}
    return options


def follow(scheduler, x, **options):
    for time in scheduler.timesteps:
        output = smooth_network(x, x.new_full(x.shape[:1], float(time)))
        x = scheduler.step(output, time, x, return_dict=False, **options)[0]
    return x


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("name", DIFFUSION)
def test_levels_and_targets_agree_with_diffusers(diffusers, name, prediction):
    oracle = diffusers.DDPMScheduler(**oracle_options(name, prediction, 100))
    schedule = NoiseSchedule(name, prediction, num_train_steps=100)
    sample, noise, time = torch.randn(100, 4, 2), torch.randn(100, 4, 2), torch.arange(100)
    torch.testing.assert_close(
        schedule.add_noise(sample, noise, time.float()), oracle.add_noise(sample, noise, time), atol=1e-5, rtol=0
    )
    if prediction == "velocity":
        expected = oracle.get_velocity(sample, noise, time)
        torch.testing.assert_close(schedule.target(sample, noise, time.float()), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("name", DIFFUSION)
@pytest.mark.parametrize("num_steps", [50, 10])
def test_ddpm_agrees_with_diffusers(diffusers, monkeypatch, name, prediction, num_steps):
    oracle = diffusers.DDPMScheduler(
        **oracle_options(name, prediction, 50), clip_sample=True, timestep_spacing="trailing"
    )
    oracle.set_timesteps(num_steps)
    noise, draws = torch.randn(6, 14, 2), torch.randn(num_steps, 6, 14, 2)
    remaining = iter(draws)
    module = __import__("diffusers.schedulers.scheduling_ddpm", fromlist=["randn_tensor"])
    monkeypatch.setattr(module, "randn_tensor", lambda *args, **kwargs: next(remaining))
    got = NoiseSchedule(name, prediction).solve(smooth_network, noise, num_steps, "ddpm", clip=1.0, step_noise=draws)
    torch.testing.assert_close(got, follow(oracle, noise), atol=1e-4, rtol=0)


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("name", DIFFUSION)
@pytest.mark.parametrize(("num_steps", "clip"), [(50, 1.0), (10, 1.0), (10, None), (5, 0.6)])
def test_ddim_agrees_with_diffusers(diffusers, name, prediction, num_steps, clip):
    oracle = diffusers.DDIMScheduler(
        **oracle_options(name, prediction, 50),
        clip_sample=clip is not None,
        clip_sample_range=clip or 1.0,
        timestep_spacing="trailing",
    )
    oracle.set_timesteps(num_steps)
    noise = torch.randn(6, 14, 2, dtype=torch.float64)
    expected = follow(oracle, noise, use_clipped_model_output=clip is not None)
    got = NoiseSchedule(name, prediction).solve(smooth_network, noise, num_steps, "ddim", clip=clip)
    torch.testing.assert_close(got, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("prediction", PREDICTIONS)
@pytest.mark.parametrize("name", DIFFUSION)
@pytest.mark.parametrize("num_steps", [20, 10, 5])
def test_dpm_solver_agrees_with_diffusers(diffusers, name, prediction, num_steps):
    oracle = diffusers.DPMSolverMultistepScheduler(
        **oracle_options(name, prediction, 50),
        algorithm_type="dpmsolver++",
        solver_order=2,
        solver_type="midpoint",
        final_sigmas_type="zero",
        lower_order_final=True,
        timestep_spacing="trailing",
    )
    oracle.set_timesteps(num_steps)
    noise = torch.randn(6, 14, 2, dtype=torch.float64)
    got = NoiseSchedule(name, prediction).solve(smooth_network, noise, num_steps, "dpm++2m")
    torch.testing.assert_close(got, follow(oracle, noise), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("solver", "oracle_name"),
    [
        ("euler", "FlowMatchEulerDiscreteScheduler"),
        ("heun", "FlowMatchHeunDiscreteScheduler"),
    ],
)
@pytest.mark.parametrize("num_steps", [4, 10])
def test_flow_solvers_agree_with_diffusers(diffusers, solver, oracle_name, num_steps):
    oracle = getattr(diffusers, oracle_name)(num_train_timesteps=1000)
    oracle.set_timesteps(num_steps)
    times = sorted({float(time) for time in oracle.timesteps}, reverse=True)
    noise = torch.randn(6, 14, 2)
    expected = follow(oracle, noise)
    got = NoiseSchedule("flow", num_train_steps=1000).solve(smooth_network, noise, num_steps, solver, times=times)
    torch.testing.assert_close(got, expected, atol=1e-4, rtol=0)
    even = NoiseSchedule("flow", num_train_steps=1000).nodes(4)
    assert [node.noise for node in even] == [1.0, 0.75, 0.5, 0.25, 0.0]
    assert math.isclose(even[1].signal, 0.25)
