# This source code is licensed under the MIT license found in the LICENSE file.
"""The seed of an environment fixes whole rollouts, alone, in batches of environments and in collectors."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch
import toy_gym  # noqa: F401 - registers
from tensordict import TensorDict
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import DoubleToFloat, GymEnv, SerialEnv, TransformedEnv

from torchrl_koap.modules import (
    Agent,
    ChunkedPolicy,
    DiffusionPolicy,
    PlanThenControl,
    PolicyEnv,
    StatePlanner,
    TemporalUnet,
    make_koopman_inverse_dynamics,
)


def plan_then_control():
    torch.manual_seed(0)
    planner = StatePlanner(TemporalUnet(4, 8, channels=(8, 16)), state_dim=4, num_steps=2)
    return PlanThenControl(planner, make_koopman_inverse_dynamics(4, 2), state_columns=range(4), history=5).eval()


def chunks():
    torch.manual_seed(0)
    diffusion = DiffusionPolicy(TemporalUnet(2, 8, channels=(8, 16)), state_dim=4, action_dim=2, num_steps=2)
    return ChunkedPolicy(diffusion, state_columns=range(4), history=2).eval()


def bare():

    return TransformedEnv(GymEnv("ToyReach-v0"), DoubleToFloat(in_keys=["observation"]))


def make_env(make_policy):
    return PolicyEnv(bare(), make_policy())


POLICIES = pytest.mark.parametrize("make_policy", [plan_then_control, chunks])
LAYOUTS = {
    "single": lambda make_policy: make_env(make_policy),
    "inside": lambda make_policy: SerialEnv(2, partial(make_env, make_policy)),
    "outside": lambda make_policy: PolicyEnv(SerialEnv(2, bare), make_policy()),
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


@POLICIES
def test_an_agent_with_the_same_seed_acts_alike(make_policy):
    env, policy = make_env(make_policy), make_policy()
    env.set_seed(3)
    with torch.no_grad():
        rollout = env.rollout(6, policy)
    agent = Agent(make_policy(), seed=3)
    agent.reset()
    for observation, action in zip(rollout["observation"], rollout["action"], strict=True):
        np.testing.assert_allclose(agent.act(observation.numpy()), action.numpy(), rtol=1e-5, atol=1e-7)


@POLICIES
def test_in_processes_of_a_collector(make_policy):
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
        fresh, carried = make_policy(), TensorDict(batch_size=[])
        for step in range(6):
            with torch.no_grad():
                carried = fresh(carried.update(episode[step].select("observation_history", "is_init", "noise")))
            torch.testing.assert_close(carried["action"], episode["action"][step], rtol=1e-4, atol=1e-6)
    assert not torch.equal(batch["observation"][0], batch["observation"][1])
