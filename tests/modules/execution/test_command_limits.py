# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests range, gain and lead: they limit commands, leave valid actions unchanged, and agree between policies."""

import math

import numpy as np
import pytest
import torch
from pretended_gpu import pretended_gpu
from small_networks import small_planner
from tensordict import TensorDict
from toy_policies import CountingPlanner, CountingSampler, EchoController

from torchrl_koap import Trained, load_policy
from torchrl_koap.modules import Agent, Execution, make_koopman_inverse_dynamics, make_policy
from torchrl_koap.modules.execution.command_limits import CommandLimits
from torchrl_koap.tasks import get_task
from torchrl_koap.training.policy_facts import policy_facts

COLUMNS = {"commands": [0, 1], "positions": [2, 3]}


def seen(command, position, batch=()):
    frames = torch.tensor([[7.0], [3.0], [1.0]]) * torch.tensor([*command, *position])  # the present one is the last
    return frames.expand(*batch, 3, 4)


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_command_ends_within_the_lead_on_every_axis(batch, dtype):
    observed = seen((0.50, 0.30), (0.45, 0.38), batch).to(dtype)
    action = torch.full((*batch, 3), 0.2, dtype=dtype)
    held, _ = CommandLimits([0, 1], lead=0.1, **COLUMNS)(observed, action)
    now = observed[..., -1, :]
    torch.testing.assert_close(now[..., :2] + held[..., :2] - now[..., 2:], torch.full((*batch, 2), 0.1, dtype=dtype))
    assert (held[..., 2] == 0.2).all() and (action == 0.2).all()  # the third is not one of the command's


def test_actions_within_the_lead_are_left_alone():
    action = 0.04 * torch.rand(1000, 2)
    limits = CommandLimits([0, 1], lead=0.1, **COLUMNS)
    assert torch.equal(limits(seen((0.5, 0.3), (0.45, 0.33), [1000]), action)[0], action)  # bit by bit


def test_a_gain_multiplies_changes_of_a_command_alone():
    assert CommandLimits([0, 2], gain=1.5)(torch.zeros(1, 1), torch.ones(4, 3))[0].tolist() == [[1.5, 1.0, 1.5]] * 4
    both, _ = CommandLimits([0, 1], gain=3.0, lead=0.1, **COLUMNS)(seen((0, 0), (0, 0)), torch.tensor([0.02, 0.05]))
    torch.testing.assert_close(both, torch.tensor([0.06, 0.1]))


def observed(batch=(3,)):
    frames, begin = torch.ones(*batch, 2, 2), torch.ones(*batch, 1, dtype=torch.bool)
    return TensorDict({"observation_history": frames, "is_init": begin}, batch)


def policy_of(kind, ranges=None, **execution):
    networks = (CountingSampler(),) if kind == "chunks" else (CountingPlanner(), EchoController())
    return make_policy(
        *networks,
        state_of=(0, 1),
        changes=(2,),
        commanded={"commands": [0], "states": [1]},
        ranges=ranges,
        execution=Execution("open_loop" if kind == "chunks" else kind, 2, blend=0.0, **execution),
    )


@pytest.mark.parametrize("kind", ["feedback", "open_loop", "chunks"])
def test_commands_stay_in_the_demonstrated_range_and_those_outside_are_counted(kind):
    plain = policy_of(kind)
    td = observed()
    free = plain(td.clone())["action"]
    low, high = float(free[..., 2].min()), float(free[..., 2].max())
    ranges = [None, None, (0.1 * low, 0.5 * low), None]
    held, wide, off = (
        policy_of(kind, ranges=ranges, limits=margin, gain=2.0) for margin in (0.5, 3 * high / low, float("inf"))
    )
    kept = torch.stack([free[..., 0], free[..., 1], torch.full_like(free[..., 2], 2 * 0.7 * low), free[..., 3]], -1)
    torch.testing.assert_close(held(td.clone())["action"], kept)  # the gain comes after it
    torch.testing.assert_close(wide(td.clone())["action"], off(td.clone())["action"], rtol=0, atol=0)
    assert (held.limited.tolist(), wide.limited.tolist(), plain.limited.tolist()) == ([3, 3], [0, 3], [0, 0])
    exported, outside = held.decode_ahead(td["observation_history"], torch.zeros(3, *plain.noise_shape))
    assert exported[..., 2].max() <= 2 * 0.7 * low and held.limited.tolist() == [3, 3]
    assert outside.shape == (3, 2) and outside[:, 0].all()
    assert not plain.decode_ahead(td["observation_history"], torch.zeros(3, *plain.noise_shape))[1].any()


@pytest.mark.parametrize("kind", ["feedback", "open_loop", "chunks"])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_every_kind_of_policy_applies_them_alike_in_rollouts_and_for_export(kind, batch):
    plain, twice, held = policy_of(kind), policy_of(kind, gain=2.0), policy_of(kind, gain=2.0, lead=0.25)
    td, noise = observed(batch), torch.zeros(*batch, *plain.noise_shape)
    free, double, near = (policy(td.clone()) for policy in (plain, twice, held))
    gains = torch.tensor([1.0, 1.0, 2.0, 1.0])
    torch.testing.assert_close(double["action"], free["action"] * gains)
    chunk = plain.out_keys[1]
    assert torch.equal(double[chunk], free[chunk])  # so the gain does not count twice in open loop
    assert torch.equal(near["action"][..., :2], free["action"][..., :2])
    assert (near["action"][..., 2].abs() == 0.25).all() and free["action"][..., 2].abs().min() > 0.25
    decoded = [policy.decode_ahead(td["observation_history"], noise)[0] for policy in (plain, twice, held)]
    torch.testing.assert_close(decoded[1], decoded[0] * gains)
    torch.testing.assert_close(decoded[2][..., 2], decoded[1][..., 2].clamp(-0.25, 0.25))


def policy_for(name, **execution):
    return make_policy(
        CountingPlanner(), EchoController(), **policy_facts(get_task(name)), execution=Execution(**execution)
    )


def test_limits_are_on_the_device_of_networks_that_were_trained_there(monkeypatch):
    with pretended_gpu(monkeypatch):
        networks = small_planner().to("cuda:0"), make_koopman_inverse_dynamics(2, 2).to("cuda:0")
        agent = Agent(make_policy(*networks, state_of=(2, 3), ranges=[(-0.01, 0.01)] * 2))
        agent.reset()
        assert np.abs(agent.act(np.ones(4))).max() <= 0.02  # the range, widened by half of it on both sides


def test_a_task_says_which_columns_they_are():
    limits = policy_for("sorting", lead=0.1).limits
    observation = torch.zeros(1, get_task("sorting").observation_dim)
    observation[:, :2] = 1.0  # the last command, a metre ahead
    torch.testing.assert_close(limits(observation, torch.zeros(2))[0], torch.tensor([-0.9, -0.9]))
    gain = policy_for("stacking", gain=1.5).limits
    assert gain(torch.zeros(1, 1), torch.ones(8))[0].tolist() == [1.5] * 7 + [1.0]  # the gripper opens as it did


def test_a_trained_policy_has_the_limits_of_its_task_by_default(tmp_path):
    policy = load_policy("pretrained:sorting")
    assert policy.limits.lead == policy.execution.lead == 0.1
    assert load_policy("pretrained:sorting", lead=0.0, limits=math.inf).limits is None
    saved = Trained.load("pretrained:sorting").save(tmp_path / "policy.safetensors")
    assert load_policy(saved, gain=1.2).execution == Execution(lead=0.1, gain=1.2, temperature=0.5)
    assert load_policy(saved, lead=0.0, gain=1.0, limits=math.inf).limits is None


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CommandLimits([0], lead=0.1, **COLUMNS), "2, 2 and 1$"),
        (lambda: CommandLimits([0], lead=0.1), "lead 0.1 was given, but the observation repeats no command"),
        (
            lambda: CommandLimits(ranges=[None])(torch.zeros(1, 1), torch.zeros(2)),
            "ranges has 1 columns, but actions have 2",
        ),
        (lambda: policy_for("scooping", lead=0.1), "lead 0.1 were given, but no action is a change of a command"),
        (lambda: policy_for("scooping", gain=1.1), "gain 1.1 and .* but no action is a change of a command"),
    ],
)
def test_limits_without_effect_raise_errors(make, message):
    with pytest.raises(ValueError, match=message):
        make()
