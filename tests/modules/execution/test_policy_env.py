# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that the seed of an environment fixes rollouts, alone, in batches and in collectors."""

from functools import partial

import pytest
import torch
from small_networks import chunk_policy, small_planner
from tensordict import TensorDict
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import ParallelEnv, RenameTransform, SerialEnv, TransformedEnv
from toy_gym import reach
from toy_policies import EpisodesOfRandomLength

from torchrl_koap.modules import Agent, PolicyEnv, make_koopman_inverse_dynamics
from torchrl_koap.modules import make_policy as build


def feedback():
    return build(small_planner(4), make_koopman_inverse_dynamics(4, 2), state_of=range(4))


def chunks():
    return chunk_policy(range(4))


def make_env(make_policy):
    return PolicyEnv(reach(), make_policy())


POLICIES = pytest.mark.parametrize("make_policy", [feedback, chunks])


def two_of(make_policy):
    return SerialEnv(2, partial(make_env, make_policy))


LAYOUTS = {
    "single": lambda make_policy: make_env(make_policy),
    "inside": lambda make_policy: SerialEnv(2, partial(make_env, make_policy)),
    "outside": lambda make_policy: PolicyEnv(SerialEnv(2, reach), make_policy()),
    "inside, [2, 2]": lambda make_policy: SerialEnv(2, partial(two_of, make_policy)),
    "outside, [2, 2]": lambda make_policy: PolicyEnv(SerialEnv(2, partial(SerialEnv, 2, reach)), make_policy()),
}


@POLICIES
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_seed_fixes_everything(make_policy, layout):
    env, policy, rollouts = LAYOUTS[layout](make_policy), make_policy(), {}
    for name, seed in {"first": 5, "again": 5, "other": 6}.items():
        env.set_seed(seed)
        torch.manual_seed(len(rollouts))  # what torch's own generator does must not matter
        with torch.no_grad():
            rollouts[name] = env.rollout(6, policy)
    for key in ("observation", "action"):
        assert torch.equal(rollouts["first"][key], rollouts["again"][key]), key
        assert not torch.equal(rollouts["first"][key], rollouts["other"][key]), key
    env.close()


def test_without_a_seed_every_environment_has_noise_of_its_own():
    first, second = (make_env(feedback).reset()["noise"] for _ in range(2))
    assert not torch.equal(first, second)


@pytest.mark.parametrize(("make_policy", "collected"), [(feedback, False), (feedback, True), (chunks, True)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_environment_is_served_as_if_it_were_alone(make_policy, layout, collected):
    env = LAYOUTS[layout](make_policy)
    if collected:
        frames = 8 * max(env.batch_size.numel(), 1)
        collector = Collector(env, make_policy(), frames_per_batch=frames, total_frames=frames)
        collector.set_seed(3)
        (rollout,) = list(collector)
        collector.shutdown()
    else:
        env.set_seed(2)
        with torch.no_grad():
            rollout = env.rollout(8, make_policy(), break_when_any_done=False)  # episodes last six steps
        env.close()
    assert rollout.shape == (*env.batch_size, 8)
    alone(make_policy, rollout)


def test_a_first_episode_is_that_of_an_agent_although_others_end_earlier():
    policy = build(small_planner(), make_koopman_inverse_dynamics(2, 2), state_of=(0, 2))
    env = PolicyEnv(EpisodesOfRandomLength(2, [[3], [20]], action_dim=2), policy)
    env.set_seed(0)
    with torch.no_grad():
        rollout = env.rollout(12, policy, break_when_any_done=False)
    noise = rollout["noise"]
    assert noise.reshape(24, -1).unique(dim=0).shape[0] == 24
    agent = Agent(policy, seed=1)
    agent.reset()
    for observation, action in zip(rollout["observation"][1], rollout["action"][1], strict=True):
        torch.testing.assert_close(agent.act(observation), action, rtol=1e-3, atol=1e-5)


def alone(make_policy, rollout):
    """A fresh policy per environment gives the same actions for what was observed there."""
    for episode in rollout.reshape(-1, rollout.shape[-1]):
        fresh, carried = make_policy(), TensorDict(batch_size=[])
        for step in episode:
            with torch.no_grad():
                carried = fresh(carried.update(step.select("observation_history", "is_init", "noise")))
            # networks with random weights answer rounding, which depends on the batch, more than trained ones do
            torch.testing.assert_close(carried["action"], step["action"], rtol=1e-3, atol=2e-3)


def test_environments_in_processes_give_the_numbers_of_a_serial_one(copied_processes):
    rollouts = []
    for kind in (SerialEnv, ParallelEnv):
        env = kind(2, partial(make_env, feedback))
        env.set_seed(7)
        with torch.no_grad():
            rollouts.append(env.rollout(8, feedback(), break_when_any_done=False))
        env.close()
    for key in ("observation", "action"):  # another process may round differently, and random weights answer that
        torch.testing.assert_close(rollouts[0][key], rollouts[1][key], rtol=1e-3, atol=1e-2)


@POLICIES
def test_in_processes_of_a_collector(make_policy, copied_processes):
    policy = make_policy()
    collector = MultiSyncCollector(
        [partial(make_env, make_policy)] * 2, policy, frames_per_batch=24, total_frames=24, cat_results="stack"
    )
    collector.set_seed(11)
    (batch,) = list(collector)
    collector.shutdown()
    assert batch.shape == (2, 12) and batch["action"].shape == (2, 12, 2)
    for worker in range(2):
        episode = batch[worker, :6]  # every episode of the toy lasts six steps
        assert episode["is_init"].flatten().tolist() == [True] + [False] * 5
    alone(make_policy, batch)
    assert not torch.equal(batch["observation"][0], batch["observation"][1])


def test_the_environment_writes_what_a_policy_of_other_keys_reads():
    policy = build(
        small_planner(4, noise_key=None), make_koopman_inverse_dynamics(4, 2), state_of=range(4), history_key="frames"
    )
    start = PolicyEnv(reach(), policy).reset()
    assert start["frames"].shape[-2:] == (5, 4) and "observation_history" not in start.keys()


def test_a_nested_done_is_refused_since_resets_would_not_renew_the_history():
    ends = ["done", "terminated", "truncated"]
    nested = TransformedEnv(reach(), RenameTransform(in_keys=ends, out_keys=[("arm", end) for end in ends]))
    with pytest.raises(ValueError, match=r"needs the key 'done', got \[\('arm', 'done'\), .*by a RenameTransform"):
        PolicyEnv(nested, feedback())


def test_the_name_of_the_observation_is_asked_for_if_it_is_another():
    renamed = TransformedEnv(reach(), RenameTransform(in_keys=["observation"], out_keys=["joints"]))
    with pytest.raises(ValueError, match="has no 'observation': name one of .*'joints'.* by observation_key"):
        PolicyEnv(renamed, feedback())
    env = PolicyEnv(renamed, feedback(), observation_key="joints")
    assert env.rollout(2, feedback())["action"].shape == (2, 2)
