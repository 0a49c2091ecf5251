# This source code is licensed under the MIT license found in the LICENSE file.
"""Which action of which chunk is executed at which step, in collectors with auto-reset and in evaluations."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType
from toy_policies import EpisodesOfRandomLength, state_number

from torchrl_koap.envs.avoiding import AvoidingEnv, mode_index
from torchrl_koap.evaluation.rollouts import measure_latency, roll_out, rollouts_to_tensors
from torchrl_koap.modules import (
    ChunkedPolicy,
    DiffusionPolicy,
    TemporalUnet,
    policy_transforms,
)

LENGTHS = ((5, 3, 11), (9,), (1, 2, 7, 4), (12, 6), (4, 4, 8))


class CountingPolicy(nn.Module):
    """Entry ``k`` of a chunk sampled at state ``x`` is ``(k, x, x of the frame before, second column of x)``."""

    history, horizon, state_dim, action_dim = 2, 6, 2, 4
    noise_shape, noise_key = (6, 4), "noise"

    def __init__(self):
        super().__init__()
        self.calls = []

    def sample(self, history, noise=None):
        assert history.shape[-2:] == (2, 2)
        self.calls.append(history[..., -1, 0].flatten().tolist())
        steps = torch.arange(6.0).expand(*history.shape[:-2], 6)
        seen = torch.stack([history[..., -1, 0], history[..., 0, 0], history[..., -1, 1]], -1)
        return torch.cat([steps.unsqueeze(-1), seen.unsqueeze(-2).expand(*steps.shape, 3)], -1)


def make_policy(interval=4, history=2, **options):
    return ChunkedPolicy(CountingPolicy(), state_columns=(1, 2), history=history, replan_interval=interval, **options)


def expected_action(env, episode, step, interval):
    """Written from the picture in the class's docstring, one step at a time."""
    sampled_at = step - step % interval
    return [
        float(step - sampled_at),
        state_number(env, episode % 5, sampled_at),
        state_number(env, episode % 5, max(sampled_at - 1, 0)),
        7.0,
    ]


@pytest.mark.parametrize("interval", [1, 3, 4, 6])
@pytest.mark.parametrize("num_envs", [1, 5])
def test_every_action_in_a_collector_with_auto_reset(interval, num_envs):
    env = TransformedEnv(EpisodesOfRandomLength(num_envs, LENGTHS), policy_transforms(2))
    policy = make_policy(interval)
    steps = 45
    collector = Collector(env, policy, frames_per_batch=15 * num_envs, total_frames=steps * num_envs)
    policy.planner.calls.clear()  # the collector tries the policy once
    data = torch.cat([batch.clone() for batch in collector], 1)
    collector.shutdown()
    for index in range(num_envs):
        episode, step, chunks = 0, 0, 0
        while data["observation"][index, 0, 1] != state_number(index, episode, 0):
            episode += 1  # the collector resets once more before it begins
        for row in range(steps):
            assert data["observation"][index, row, 1] == state_number(index, episode % 5, step)
            expected = expected_action(index, episode, step, interval)
            assert data["action"][index, row].tolist() == expected, (index, episode, step)
            chunks += step % interval == 0
            step += 1
            if data["next", "done"][index, row]:
                episode, step = episode + 1, 0
        made = sum(int(number // 100) == index for call in policy.planner.calls for number in call)
        assert made == chunks  # sampled for rows that need a chunk, and for no others


def step_input(observed, **more):
    batch = observed.shape[:-2]
    init = torch.ones(*batch, 1, dtype=torch.bool)
    return TensorDict({"observation_history": observed, "is_init": init, **more}, batch)


def test_longer_histories_masks_and_functions_of_observations():
    observed = torch.arange(30.0).reshape(2, 5, 3)
    action = make_policy(history=5)(step_input(observed))["action"]
    assert action.tolist() == [[0, 13, 10, 14], [0, 28, 25, 29]]
    masked = ChunkedPolicy(
        CountingPolicy(), state_columns=lambda seen: 10 * seen, history=5, controller_columns=(2, 0)
    )(step_input(observed))["action"]
    assert masked.tolist() == [[0, 140, 110, 120], [0, 290, 260, 270]]
    assert masked.shape == (2, 4)


def test_renamed_keys():
    renamed = make_policy(history_key=("agent", "frames"), action_key=("agent", "command"))
    plain, observed = make_policy(), torch.rand(3, 2, 3)
    one = TensorDict({"agent": {"frames": observed}, "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
    other = step_input(observed)
    for _ in range(6):
        one, other = renamed(one), plain(other)
        assert torch.equal(one["agent", "command"], other["action"])
        assert set(renamed.out_keys) <= set(one.keys(True))
        for td in (one, other):
            td["is_init"] = torch.zeros(3, 1, dtype=torch.bool)
    assert list(renamed.in_keys) == [("agent", "frames"), "is_init"]


def test_wrong_arguments_and_missing_transforms_are_named():
    with pytest.raises(ValueError, match="policy reads 2 observed frames, history is only 1"):
        make_policy(history=1)
    for interval in (0, 7):
        with pytest.raises(ValueError, match=rf"replan_interval must be in 1..6 \(the horizon\), got {interval}"):
            make_policy(interval)
    with pytest.raises(KeyError, match="reads 'observation_history': append policy_transforms"):
        EpisodesOfRandomLength(2, LENGTHS).rollout(2, make_policy())
    with pytest.raises(KeyError, match="reads 'is_init': append policy_transforms"):
        make_policy()(step_input(torch.zeros(2, 2, 3)).exclude("is_init"))
    with pytest.raises(ValueError, match=r"must hold 2 frames on axis -2, got \[2, 4, 3\]"):
        make_policy()(step_input(torch.zeros(2, 4, 3)))


def diffusion_policy():
    """Untrained; its actions point ahead on the whole, at about half a centimetre per step."""
    torch.manual_seed(0)
    policy = DiffusionPolicy(TemporalUnet(2, 6, channels=(8, 16)), state_dim=3, action_dim=2, num_steps=3)
    actions = torch.stack([0.004 * torch.randn(200), 0.01 * torch.rand(200)], -1)
    policy.fit_normalizers(0.01 * torch.randn(50, 16, 3).cumsum(1), actions)
    return policy.eval()


def test_evaluations_do_not_depend_on_the_batch_size():
    policy = ChunkedPolicy(diffusion_policy(), state_columns=(1, 2, 3), history=2)
    seeds = [100, 101, 102, 103]
    together, apart = (roll_out(policy, AvoidingEnv, seeds, max_steps=10, batch_size=size) for size in (None, 1))
    for one, other in zip(apart, together, strict=True):
        assert (one["next", "observation"] - other["next", "observation"]).abs().max() < 1e-4
        assert (one["action"] - other["action"]).abs().max() < 1e-4
    assert not torch.allclose(together[0]["action"], together[1]["action"])
    chunks = together[0]["action_chunk"]
    for step in range(10):
        assert torch.equal(together[0]["action"][step], chunks[step, step % 4])
        assert torch.equal(chunks[step], chunks[step - step % 4])
    assert not torch.equal(chunks[4], chunks[0])
    again = roll_out(policy, AvoidingEnv, seeds[:1], max_steps=10)
    assert torch.equal(again[0]["action"], apart[0]["action"])


def test_pictures_and_latency_need_no_plans():
    policy = ChunkedPolicy(diffusion_policy(), state_columns=(1, 2, 3), history=2)
    episodes = roll_out(policy, AvoidingEnv, [1, 2], max_steps=6)
    tensors = rollouts_to_tensors(episodes, position=slice(2, 4), mode_index=mode_index, interval=4)
    assert tensors["plan"].shape == (2, 0, 1, 2) and tensors["plan_step"].shape == (2, 0)
    assert tensors["action"].shape == (2, 6, 2) and tensors["position"].shape == (2, 7, 2)
    result = measure_latency(policy, 4, repeats=5)
    assert result["plan_ms"] > result["control_ms"] > 0
    assert result["control_hz"] == pytest.approx(1e3 / (result["control_ms"] + result["plan_ms"] / 4))


def test_a_stochastic_start_stays_stochastic_under_deterministic_exploration():
    env = TransformedEnv(AvoidingEnv(20), policy_transforms(2))
    policy = ChunkedPolicy(diffusion_policy(), state_columns=(1, 2, 3), history=2)
    collector = Collector(
        env, policy, frames_per_batch=20 * 5, total_frames=20 * 5, exploration_type=ExplorationType.DETERMINISTIC
    )
    (data,) = collector
    collector.shutdown()
    assert data.shape == (20, 5) and data["action"].isfinite().all()
    assert data["action"][:, 0].unique(dim=0).shape[0] == 20  # all begin at the same place
