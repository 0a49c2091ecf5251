# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that an episode's noise depends on seed and step alone, equally in agents, environments and evaluations."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.modules import Agent, Execution, MLPDenoiser, StatePlanner, make_koopman_inverse_dynamics, make_policy
from torchrl_koap.modules.execution.policy_env import NoiseStreams, NoiseTransform


def test_a_stream_is_that_of_its_seed_whatever_else_is_drawn():
    together, alone = NoiseStreams([3, 9, 4], (5, 2), block=4), NoiseStreams([9], (5, 2), block=4)
    state, draws = torch.get_rng_state(), []
    for _ in range(9):  # more than two blocks
        draws.append(together.draw())
        assert torch.equal(draws[-1][1:2], alone.draw())
    assert torch.stack(draws).flatten().unique().numel() == 9 * 3 * 10
    assert torch.equal(torch.get_rng_state(), state)  # the global generator is left alone
    block = torch.randn(4, 5, 2, generator=torch.Generator().manual_seed(3))
    assert torch.equal(torch.stack(draws[:4])[:, 0], block)


def test_any_batch_is_written():
    td = NoiseTransform((5, 2), block=1, noise_key="z")._call(TensorDict(batch_size=[2, 3]))
    assert td["z"].shape == (2, 3, 5, 2)


def test_the_specification_is_that_of_the_noise_whatever_the_default_type_of_torch():
    transform = NoiseTransform((5, 2), block=1)
    torch.set_default_dtype(torch.float64)
    try:
        spec = transform.transform_observation_spec(Composite(shape=[3]))["noise"]
        assert spec.is_in(transform._call(TensorDict(batch_size=[3]))["noise"])
    finally:
        torch.set_default_dtype(torch.float32)


class Still(StatePlanner):
    """Plans that are their own start noise, so that actions tell every bit of it."""

    def sample(self, history, noise=None):
        return noise


@pytest.mark.parametrize("given", [True, False])
def test_the_temperature_is_a_factor_of_the_start_noise(given):
    planner = Still(MLPDenoiser(4, 8, horizon=14, width=8), state_dim=4)
    plans = []
    for temperature in (1.0, 0.5, 0.0):
        execution = Execution(temperature=temperature)
        policy = make_policy(planner, make_koopman_inverse_dynamics(4, 2), state_of=range(4), execution=execution)
        torch.manual_seed(0)
        noise = torch.randn(3, 14, 4) if given else None
        plans.append(policy.plan(torch.zeros(3, policy.history, 4), noise))
    assert plans[0].std() > 0.9 and torch.equal(plans[1], plans[0] / 2) and not plans[2].any()


@pytest.mark.parametrize("batch", [(), (2, 2)])
def test_of_several_candidates_the_first_of_the_nearest_pair_is_planned(batch):
    planner = Still(MLPDenoiser(4, 8, horizon=14, width=8), state_dim=4)
    execution = Execution(temperature=0.5, candidates=4)
    policy = make_policy(planner, make_koopman_inverse_dynamics(4, 2), state_of=range(4), execution=execution)
    assert policy.noise_shape == (4, 14, 4)
    noise = torch.tensor([0.0, 5.0, 9.0, 5.5]).reshape(4, 1, 1).expand(*batch, *policy.noise_shape).clone()
    if batch:
        noise[0, 1] = noise[0, 1].flip(0)  # 5.5 is now the first of the pair
    plan = policy.plan(torch.zeros(*batch, policy.history, 4), noise)
    expected = torch.full((*batch, 14, 4), 2.5)
    if batch:
        expected[0, 1] = 2.75
    assert torch.equal(plan, expected)


def test_candidates_are_compared_in_normalised_units_and_begin_with_the_prefix():
    def first_of_nearest(plans):
        gaps = [(plans[:, one] - plans[:, two]).square().sum((-1, -2)) for one, two in ((0, 1), (0, 2), (1, 2))]
        return torch.tensor([0, 0, 1])[torch.stack(gaps).argmin(0)]

    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8), state_dim=2, num_steps=2)
    planner.fit_normalizers(torch.tensor([1e3, 1e-3]) * torch.randn(50, 16, 2).cumsum(1))
    given = {"state_of": (0, 1), "execution": Execution(candidates=3)}
    policy = make_policy(planner, make_koopman_inverse_dynamics(2, 2), **given)
    states, noise = torch.zeros(20, policy.history, 2), torch.randn(20, 3, 14, 2)
    prefix = torch.tensor([1e2, 1e-4]) * torch.ones(20, 2, 2)
    plans = torch.stack([planner.sample(states[:, -2:], noise[:, which], prefix=prefix) for which in range(3)], 1)
    first = first_of_nearest(planner.encode(states[:, None, -2:], plans))
    assert len(first.unique()) == 2 and (first != first_of_nearest(plans)).any()
    with pytest.raises(ValueError, match=r"'noise' must be \[20, 3, 14, 2\] .* got \[20, 14, 2\]"):
        policy.sample(states, noise[:, 0])
    plan = policy.sample(states, noise, prefix=prefix)
    torch.testing.assert_close(plan, plans[torch.arange(20), first], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(plan[:, :2], prefix, rtol=1e-4, atol=1e-6)


def test_planners_without_normalised_plans_have_one_candidate():
    class Own(torch.nn.Module):
        history, horizon, noise_key, noise_shape = 1, 14, None, (14, 2)

    with pytest.raises(ValueError, match="candidates must be 1 for Own, which is no ConditionalSampler"):
        make_policy(Own(), make_koopman_inverse_dynamics(2, 2), state_of=(0, 1), execution=Execution(candidates=2))


@pytest.mark.parametrize("candidates", [1, 3])
def test_the_episode_of_a_seed_in_an_evaluation_is_that_of_an_agent(candidates):
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=13, width=8), state_dim=2, horizon=13, num_steps=2)
    planner.fit_normalizers(0.01 * torch.randn(50, 15, 2).cumsum(1))
    options = {"state_of": (2, 3), "max_steps": 9, "execution": Execution(candidates=candidates)}
    policy = make_policy(planner, make_koopman_inverse_dynamics(2, 2), **options)
    (episode,) = roll_out(policy, AvoidingEnv, [7], max_steps=9)
    agent = Agent(policy, seed=7)
    agent.reset()
    for observation, action in zip(episode["observation"], episode["action"], strict=True):
        assert torch.equal(agent.act(observation), action)
