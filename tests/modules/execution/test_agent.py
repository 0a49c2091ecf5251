# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests a policy in a control loop: equal actions as in rollouts, one robot or a batch, clear errors."""

import warnings

import numpy as np
import pytest
import torch
from small_networks import chunk_policy, small_planner
from torchrl.collectors import Collector
from toy_gym import reach

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.modules import Agent, Execution, PolicyEnv, make_koopman_inverse_dynamics, make_policy
from torchrl_koap.modules.execution.agent import percentiles

STEPS = 13


def policy_of(strategy="feedback", columns=(0, 1), **options):
    planner = small_planner(**options)
    return make_policy(planner, make_koopman_inverse_dynamics(2, 2), state_of=columns, execution=Execution(strategy))


def ready(policy=None, **options):
    agent = Agent(policy_of() if policy is None else policy, **options)
    agent.reset()
    return agent


POLICIES = [lambda: policy_of(), lambda: policy_of("open_loop"), chunk_policy]


@pytest.mark.parametrize("make", POLICIES, ids=["feedback", "open loop", "chunks"])
@pytest.mark.parametrize("robots", [1, 3])
def test_the_actions_of_a_rollout_bit_for_bit(make, robots):
    policy = make()
    env = PolicyEnv(reach(robots, length=20), policy)
    env.set_seed(7)
    with torch.no_grad():
        rollout = env.rollout(STEPS, policy)
    agent = ready(policy, seed=7)
    for step in range(STEPS):
        action = agent.act(rollout["observation"][:, step])
        assert torch.equal(action, rollout["action"][:, step]), step


def test_a_temperature_multiplies_the_noise_of_a_rollout_in_float64_too():
    execution = Execution(temperature=0.4)
    policy = make_policy(small_planner(), make_koopman_inverse_dynamics(2, 2), state_of=(2, 3), execution=execution)
    env = PolicyEnv(AvoidingEnv(2, dtype=torch.float64), policy.double())
    env.set_seed(7)
    rollout = env.rollout(2, policy)
    assert torch.equal(ready(policy, seed=7).act(rollout["observation"][:, 0]), rollout["action"][:, 0])


def test_numpy_or_torch_one_robot_or_several():
    agent = ready(seed=3)
    one = agent.act(np.array([0.1, 0.2]))
    assert isinstance(one, np.ndarray) and one.shape == (2,) and one.dtype == np.float32
    agent.reset()
    several = agent.act(torch.tensor([[0.1, 0.2], [0.1, 0.2]], dtype=torch.float64))
    assert isinstance(several, torch.Tensor) and several.shape == (2, 2) and not several.requires_grad
    np.testing.assert_allclose(several[0].numpy(), one, rtol=1e-5)
    assert not torch.allclose(several[0], several[1])  # a stream of noise per robot


def test_what_a_robot_gives_is_observed_first():
    policy = make_policy(
        small_planner(),
        make_koopman_inverse_dynamics(2, 2),
        state_of=(0, 1),
        observe=lambda given: torch.as_tensor(given["state"]) + given["top"].mean(),
    )
    action = ready(policy, seed=3).act({"state": np.zeros(2), "top": np.full((4, 4, 3), 2.0)})
    assert isinstance(action, np.ndarray) and np.array_equal(action, ready(policy, seed=3).act(np.full(2, 2.0)))
    with pytest.raises(ValueError, match=r"trained without cameras: it takes one vector \[obs\], got state, top"):
        ready().act({"state": np.zeros(2), "top": np.zeros((4, 4, 3))})


def test_reset_forgets_the_episode_before():
    path, runs = np.random.default_rng(0).normal(size=(6, 2)), []
    for before in (path, -path):  # as much noise is drawn
        agent = Agent(policy_of())
        for episode in (before, path):
            agent.reset()
            actions = [agent.act(row) for row in episode]
        runs.append(actions)
    np.testing.assert_array_equal(*runs)
    assert agent.latency()["steps"] == 12 and agent.latency()["p50"] <= agent.latency()["p99"] <= agent.latency()["max"]


def test_a_state_far_from_the_demonstrations_is_told_once_per_column_and_episode():
    """Also in the middle of an episode, and in every episode under the default filter, which drops repeated texts."""
    policy = policy_of()
    policy.planner.fit_normalizers(torch.rand(50, 16, 2))
    agent = ready(policy)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for _ in range(2):
            for row in ([-0.9, 1.9], [1.9, 57.3], [1.9, 57.3], [300.0, 57.3]):
                agent.act(np.array(row))
            agent.reset()
    texts = [str(each.message).partition(" of the state")[0] for each in told]
    assert texts == [f"in episode {episode} columns [{column}]" for episode in (1, 2) for column in (1, 0)]
    assert {each.filename for each in told} == {__file__}


def test_refusals():
    with pytest.raises(TypeError, match=r"must come from load_policy\(\) or Trained.policy\(\), got str"):
        Agent("runs/arm")
    agent = Agent(policy_of())
    with pytest.raises(RuntimeError, match="reset.. the agent before the first act"):
        agent.act(np.zeros(2))
    with pytest.raises(RuntimeError, match="no latency has been measured"):
        agent.latency()
    agent.reset()
    with pytest.raises(ValueError, match="must have at least 2 columns .state_of., got 1"):
        agent.act(np.zeros(1))
    agent.act(np.zeros(2))  # what was refused is not kept
    with pytest.raises(ValueError, match=r"the observation has shape \[3\], earlier ones had \[2\]; reset"):
        agent.act(np.zeros(3))


def test_arrays_of_any_kind_are_observations():
    """What a robot's driver hands over: a mask means that there is no number."""
    wanted = np.array([0.5, -0.25])
    acted = []
    for given in (wanted, wanted.astype(">f4"), wanted[::-1].copy()[::-1], wanted.astype(object), wanted.tolist()):
        acted.append(ready(seed=0).act(given))
        np.testing.assert_array_equal(acted[0], acted[-1])


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (np.ma.masked_array([0.5, 1.0], mask=[0, 1]), r"columns \[1\] of the observation are NaN"),
        ([0.5, None], r"columns \[1\] of the observation are NaN"),
        (np.array([1e300, 0]), r"columns \[0\] of the observation are NaN or infinite as torch.float32"),
        (np.array([1e38, 0]), "the action is not finite: this observation is too far from"),
        (np.zeros(2, "datetime64[s]"), "must be numbers .*, got ndarray"),
        (["left", "right"], "must be numbers .*, got list"),
        ([[1.0, 2.0], [3.0]], "must be numbers .*, got list"),
        (None, "must be numbers .*, got NoneType"),  # a reading that never came
        (0.5, "must be numbers .*, got float"),
        (np.zeros((1, 1, 2)), r"must be \[obs\] or \[n, obs\], got \[1, 1, 2\]"),
    ],
)
def test_what_is_no_observation(given, says):
    with pytest.raises(ValueError, match=says):
        ready().act(given)


def test_an_observation_without_a_finite_action_does_not_spoil_the_next_ones():
    agent = ready()
    with pytest.raises(ValueError, match="the action is not finite"):
        agent.act(np.array([1e38, 0]))
    assert all(np.isfinite(agent.act(np.zeros(2))).all() for _ in range(6))


@pytest.mark.parametrize("seed", ["1", None, 1.5, True, -1])
def test_what_is_no_seed(seed):
    with pytest.raises(ValueError, match=f"seed must be a whole number >= 0, got {seed!r}"):
        ready(seed=seed)


def test_a_planner_that_draws_by_itself_is_handed_no_noise():
    assert np.isfinite(ready(policy_of(columns=(2, 3), noise_key=None)).act(np.zeros((3, 4)))).all()


def test_latencies_do_not_grow_for_ever(monkeypatch):
    monkeypatch.setattr("torchrl_koap.modules.execution.agent.KEPT", 3)
    agent = ready()
    for _ in range(5):
        agent.act(np.zeros(2))
    assert agent.latency()["steps"] == 3
    assert percentiles([step / 1000 for step in range(101)]) == pytest.approx(
        {"p50": 50, "p99": 99, "max": 100, "steps": 101}
    )


def test_episodes_of_an_agent_differ_and_are_drawn_again_by_its_seed():
    def episodes(seed):
        agent, found = Agent(policy_of(), seed=seed), []
        for _ in range(2):
            agent.reset()
            found.append(np.stack([agent.act(np.zeros(2)) for _ in range(6)]))
        return found

    first, second = episodes(3)
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(episodes(3), [first, second])


@pytest.mark.parametrize("make", POLICIES, ids=["feedback", "open loop", "chunks"])
def test_a_compiled_policy_makes_every_plan_that_is_due(make):
    """Three plans and a step, in an agent, in a collector, and with the denoiser compiled in place."""
    policy = make()
    path = np.random.default_rng(0).normal(size=(STEPS, 2))

    def acted(policy):
        agent = ready(policy, seed=7)
        return np.stack([agent.act(row) for row in path])

    def collected(compiled):
        torch.set_num_threads(1)  # a collector that shuts down leaves more, and sums are made in another order
        env = PolicyEnv(reach(2, length=20), policy)
        env.set_seed(7)
        options = {"frames_per_batch": 2 * STEPS, "total_frames": 2 * STEPS, "compile_policy": compiled}
        collector = Collector(env, policy, **options)
        actions = next(iter(collector))["action"].clone()
        collector.shutdown()
        return actions

    plain = acted(policy)
    np.testing.assert_array_equal(acted(torch.compile(policy, backend="aot_eager")), plain)
    assert torch.equal(collected({"backend": "aot_eager"}), collected(None))
    policy.compile(backend="aot_eager")
    np.testing.assert_allclose(acted(policy), plain, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("offset", [4e6, 1e8])
def test_an_origin_is_subtracted_and_added_in_float64(offset):
    path = np.random.default_rng(0).normal(size=(6, 2))
    far = make_policy(
        small_planner(),
        make_koopman_inverse_dynamics(2, 2),
        state_of=(0, 1),
        origins=((offset, -offset), (0.0, offset)),
    )
    agents = ready(), ready(far)
    for place in path:
        near, moved = agents[0].act(place), agents[1].act(place + [offset, -offset])
        assert moved.dtype == np.float64
        np.testing.assert_allclose(moved - [0, offset], near, rtol=0, atol=1e-6)
    with pytest.raises(ValueError, match="use an Agent"):
        PolicyEnv(reach(1), far)
