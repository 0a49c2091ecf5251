# This source code is licensed under the MIT license found in the LICENSE file.
"""Policies in batches of any shape: single environments, serial and parallel ones, transforms inside and outside."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from toy_policies import CountingPlanner, EchoController

from torchrl_koap.modules import (
    ChunkedPolicy,
    DiffusionPolicy,
    MLPDenoiser,
    PlanThenControl,
    RecordedFutures,
    RecordedPlanner,
    StatePlanner,
    policy_transforms,
)

KINDS = ("feedback", "open_loop", "chunks")
LENGTH = 6


class Counting(EnvBase):
    """One environment, batch ``[]``: observes ``100 episode + step``; an episode has six steps."""

    def __init__(self, action_dim):
        super().__init__()
        self.observation_spec = Composite({"observation": Unbounded((2,))})
        self.action_spec, self.reward_spec = Unbounded((action_dim,)), Unbounded((1,))
        self.episode, self.step_number = -1, 0

    def _seen(self, **more):
        now = float(100 * max(self.episode, 0) + self.step_number)
        done = torch.tensor([self.step_number >= LENGTH])
        return TensorDict({"observation": torch.tensor([now, 7.0]), "done": done, "terminated": done.clone(), **more})

    def _reset(self, tensordict):
        self.episode, self.step_number = self.episode + 1, 0
        return self._seen()

    def _step(self, tensordict):
        self.step_number += 1
        return self._seen(reward=torch.zeros(1))

    def _set_seed(self, seed):
        pass


class CountingDiffusion(CountingPlanner):
    """Action ``k`` of a chunk sampled at ``x`` is ``(k, x)``."""

    def sample(self, history, noise=None):
        now = history[..., -1, 0]
        steps = torch.arange(6.0).expand(*now.shape, 6)
        return torch.stack([steps, now.unsqueeze(-1).expand_as(steps)], -1)


def make_policy(kind):
    if kind == "chunks":
        return ChunkedPolicy(CountingDiffusion(), state_columns=(0, 1), history=2)
    return PlanThenControl(
        CountingPlanner(), EchoController(), state_columns=(0, 1), history=2, execution=kind, blend_decay=0.0
    )


def expected_actions(kind, observed):
    """Actions of the steps of one environment ``[T]``, from what it observed; episodes have six steps, plans four."""
    actions = []
    for now in observed:
        step = int(now) % 100
        made, age = now - step % 4, step % 4
        if kind == "chunks":
            actions.append([age, made])
        else:
            ahead = made + 1000 * age if age else now  # open loop counts on being where it planned to be
            here, before = (ahead, made + 1000 * (age - 1)) if kind == "open_loop" else (now, now - (step > 0))
            if kind == "open_loop" and age == 0:
                before = now - (step > 0)
            actions.append([before, here, made + 1000 * (age + 1), made])
    return actions


def environments(name, kind):
    """An environment of the named make with the policy's transforms inside or outside."""
    dim = 2 if kind == "chunks" else 4
    single, transformed = lambda: Counting(dim), lambda: TransformedEnv(Counting(dim), policy_transforms(2))  # noqa: E731
    return {
        "single": transformed,
        "serial": lambda: TransformedEnv(SerialEnv(3, single), policy_transforms(2)),
        "serial, transforms inside": lambda: SerialEnv(3, transformed),
        "two dimensions": lambda: TransformedEnv(SerialEnv(2, lambda: SerialEnv(3, single)), policy_transforms(2)),
        "parallel, transforms inside": lambda: ParallelEnv(2, transformed),
    }[name]()


def check(kind, data):
    observed = data["observation"][..., 0]
    flat = observed.reshape(-1, observed.shape[-1])
    actions = data["action"].reshape(len(flat), observed.shape[-1], -1)
    for row, action in zip(flat, actions, strict=True):
        assert action.tolist() == expected_actions(kind, row.tolist())
        assert row.max() >= 100  # more than one episode


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["single", "serial", "serial, transforms inside", "two dimensions"])
def test_every_action_with_auto_reset(kind, name):
    env = environments(name, kind)
    check(kind, env.rollout(15, make_policy(kind), break_when_any_done=False))
    steps = 15 * max(env.batch_size.numel(), 1)
    collector = Collector(env, make_policy(kind), frames_per_batch=steps, total_frames=steps)
    (data,) = collector
    check(kind, data)
    collector.shutdown()


def test_every_action_of_parallel_workers_that_reset_by_themselves():
    env = environments("parallel, transforms inside", "feedback")
    check("feedback", env.rollout(15, make_policy("feedback"), break_when_any_done=False))
    env.close()


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("kind", KINDS)
def test_batches_of_any_shape_agree_with_the_flat_one_noise_included(kind, batch):
    torch.manual_seed(0)
    if kind == "chunks":
        diffusion = DiffusionPolicy(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2, action_dim=2)
        policy = ChunkedPolicy(diffusion, state_columns=(0, 1), history=2)
    else:
        planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2)
        policy = PlanThenControl(planner, EchoController(), state_columns=(0, 1), history=2, execution=kind)
    observed, noise = torch.randn(*batch, 2, 2), torch.randn(*batch, 14, 2)
    init = torch.ones(*batch, 1, dtype=torch.bool)
    shaped = TensorDict({"observation_history": observed, "noise": noise, "is_init": init}, batch)
    flat = shaped.reshape(-1) if batch else shaped.unsqueeze(0)
    with torch.no_grad():
        for _ in range(6):
            shaped, flat = policy(shaped), policy(flat)
            assert shaped.batch_size == torch.Size(batch)
            for key in (*policy.out_keys, "counter"):
                torch.testing.assert_close(shaped[key], flat[key].reshape(*batch, *flat[key].shape[1:]))
            shaped["is_init"], flat["is_init"] = torch.zeros_like(init), torch.zeros_like(flat["is_init"])


def test_the_last_word_on_actions_sees_the_whole_window():
    seen = []

    def rule(states, actions):
        seen.append(states)
        return actions + 0.5

    policy = PlanThenControl(
        CountingPlanner(),
        EchoController(),
        state_columns=(0, 1),
        history=2,
        controller_columns=(0, 1),
        action_rule=rule,
    )
    observed = torch.tensor([[[3.0, 7.0], [4.0, 7.0]]])
    td = policy(TensorDict({"observation_history": observed, "is_init": torch.ones(1, 1, dtype=torch.bool)}, [1]))
    assert td["action"][0, :2].tolist() == [3.5, 4.5]
    assert seen[0][0, :, 0].tolist() == [3, 4] + [4 + 1000.0 * k for k in range(1, 7)]  # plans as they were made


def test_recorded_futures_travel_in_an_entry_of_their_own():
    recorded = RecordedFutures(torch.arange(2 * 3 * 14 * 2.0).reshape(2, 3, 14, 2))
    planner = RecordedPlanner(StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2))
    policy = PlanThenControl(
        planner, EchoController(), state_columns=(0, 1), history=2, replan_interval=1, blend_decay=0.0
    )
    observed, init = torch.zeros(2, 2, 2), torch.ones(2, 1, dtype=torch.bool)
    for step in (0, 1, 2, 2):
        td = TensorDict({"observation_history": observed, "is_init": init, "noise": torch.full((2, 1), torch.nan)}, [2])
        td = policy(recorded(td))
        assert torch.equal(td["action"][:, 2:], recorded.futures[:, step, 0])
