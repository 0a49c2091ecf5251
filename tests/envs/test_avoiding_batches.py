# This source code is licensed under the MIT license found in the LICENSE file.
"""Environments of one AvoidingEnv are independent: partial resets and steps, threads, rollouts, a collector."""

from __future__ import annotations

import numpy as np
import torch
from avoiding_steps import INTO_ROW_1, act
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import StepCounter

from torchrl_koap.envs.avoiding import AvoidingEnv


def leaves(env, steps=40, **arguments):
    generator = torch.Generator().manual_seed(3)
    aims = (torch.rand(7, 2, generator=generator) * torch.tensor([0.02, 0.01]) - torch.tensor([0.01, 0.0]))[
        : env.batch_size[0]
    ]
    return env.rollout(steps, lambda td: td.set("action", aims), break_when_any_done=False, **arguments)


def test_batch_size_and_threads_change_nothing():
    alone = leaves(AvoidingEnv(7))
    for env in (AvoidingEnv(7, num_threads=2), AvoidingEnv(7, num_threads=4)):
        torch.testing.assert_close(leaves(env), alone, rtol=0, atol=0)
    torch.testing.assert_close(leaves(AvoidingEnv(2)), alone[:2], rtol=0, atol=0)


def test_partial_reset_leaves_the_others_alone():
    env, plain = AvoidingEnv(3, dtype=torch.float64), AvoidingEnv(3, dtype=torch.float64)
    start = env.reset()
    plain.reset()
    for _ in range(10):
        act(env, INTO_ROW_1), act(plain, INTO_ROW_1)
    before = [data.qpos.copy() for data in env.sims.data]
    mask = torch.tensor([[False], [True], [False]])
    out = env.reset(TensorDict({"_reset": mask}, [3]))
    torch.testing.assert_close(out["observation"][1], start["observation"][1], rtol=0, atol=0)
    np.testing.assert_array_equal(env.sims.data[0].qpos, before[0])
    np.testing.assert_array_equal(env.sims.data[2].qpos, before[2])
    for _ in range(30):
        got, wanted = act(env, INTO_ROW_1), act(plain, INTO_ROW_1)
        torch.testing.assert_close(got[[0, 2]], wanted[[0, 2]], rtol=0, atol=0)
    assert env._steps.tolist() == [40, 30, 40]


def test_partial_step_freezes_the_others():
    env = AvoidingEnv(2, dtype=torch.float64)
    env.reset()
    held = act(env, INTO_ROW_1)
    before = env.sims.data[1].qpos.copy()
    bad_where_skipped = torch.stack([INTO_ROW_1, torch.full_like(INTO_ROW_1, float("nan"))])
    out = act(env, bad_where_skipped, mask=[True, False])
    np.testing.assert_array_equal(env.sims.data[1].qpos, before)
    torch.testing.assert_close(out["observation"][1], held["observation"][1], rtol=0, atol=0)
    assert not torch.equal(out["observation"][0], held["observation"][0])
    assert env._steps.tolist() == [2, 1] and env._ready.all()


def test_rollout_with_one_episode_per_environment():
    env = AvoidingEnv(3, max_steps=60, dtype=torch.float64)
    actions = torch.stack([INTO_ROW_1, 1.2 * INTO_ROW_1, 0 * INTO_ROW_1])
    data = env.rollout(100, lambda td: td.set("action", actions), break_when_any_done=False, break_when_all_done=True)
    final = data[:, -1]["next"]
    assert data.shape == (3, 60)
    assert final["collision"][:, 0].tolist() == [True, True, False]
    assert final["truncated"][2].item() and not final["success"].any()


def test_collector_restarts_environments_that_end_at_different_times():
    actions = torch.stack([INTO_ROW_1, 1.3 * INTO_ROW_1, 0 * INTO_ROW_1]).float()
    env = TransformedEnv(AvoidingEnv(3, max_steps=37), StepCounter())
    policy = TensorDictPolicy(actions)
    collector = Collector(
        env, policy, frames_per_batch=3 * 90, total_frames=3 * 90, auto_register_policy_transforms=False
    )
    data = next(iter(collector))
    collector.shutdown()
    ends = [row.nonzero().flatten().tolist() for row in data["next", "done"][..., 0]]
    assert ends[0] != ends[1] and len(ends[0]) >= 2 and ends[2] == [36, 73]
    start = AvoidingEnv(1).reset()["observation"][0]
    for row, row_ends in enumerate(ends):
        for end in row_ends:
            torch.testing.assert_close(data["observation"][row, end + 1], start, rtol=0, atol=0)
            assert data["step_count"][row, end + 1].item() == 0
    # every episode of an environment repeats the first one bit for bit
    length = ends[0][0] + 1
    first, second = data["observation"][0, :length], data["observation"][0, length : 2 * length]
    torch.testing.assert_close(first, second, rtol=0, atol=0)


class TensorDictPolicy(torch.nn.Module):
    def __init__(self, actions):
        super().__init__()
        self.register_buffer("actions", actions)

    def forward(self, tensordict):
        return tensordict.set("action", self.actions)
