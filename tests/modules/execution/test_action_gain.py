# This source code is licensed under the MIT license found in the LICENSE file.
"""The gain of a policy's actions: larger changes of the command, everything else as it was."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from toy_policies import CountingPlanner, EchoController

from torchrl_koap import load_policy, save_policy
from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.evaluation.rollouts import make_gain
from torchrl_koap.evaluation.trained_run import execution_of
from torchrl_koap.modules import ChunkedPolicy, CommandLeash, DiffusionPolicy, PlanThenControl, TemporalUnet
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.tasks import get_task

GAINS = torch.tensor([1.0, 2.0, 3.0, 4.0])


def observed(batch=(3,)):
    frames, begin = torch.ones(*batch, 2, 2), torch.ones(*batch, 1, dtype=torch.bool)
    return TensorDict({"observation_history": frames, "is_init": begin}, batch)


def policy_of(**options):
    return PlanThenControl(
        CountingPlanner(), EchoController(), state_columns=(0, 1), history=2, replan_interval=2, **options
    )


@pytest.mark.parametrize("execution", ["feedback", "open_loop"])
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)])
def test_actions_are_multiplied_and_plans_are_not(execution, batch):
    policy, td = policy_of(execution=execution, blend_decay=0.0), observed(batch)
    plain = policy(td.clone())
    policy.action_gain = GAINS
    again = policy(td.clone())
    torch.testing.assert_close(again["action"], plain["action"] * GAINS)
    assert plain["action"].count_nonzero()
    chunk = policy.out_keys[1]
    assert torch.equal(again[chunk], plain[chunk])  # so the gain does not count twice in open loop
    noise = torch.zeros(*batch, *policy.noise_shape)
    decoded = policy.plan_and_decode(td["observation_history"], noise)
    policy.action_gain = None
    torch.testing.assert_close(decoded, policy.plan_and_decode(td["observation_history"], noise) * GAINS)


def test_chunks_of_actions_have_it_too():
    torch.manual_seed(0)
    sampler = DiffusionPolicy(TemporalUnet(3, 4, channels=(8, 16)), state_dim=2, action_dim=3)
    policy = ChunkedPolicy(sampler, state_columns=(0, 1), history=2, replan_interval=2)
    td, noise = observed([3]), torch.randn(3, *policy.noise_shape)
    td[sampler.noise_key] = noise
    plain, decoded = policy(td.clone())["action"], policy.plan_and_decode(td["observation_history"], noise)
    policy.action_gain = torch.tensor([2.0, 1.0, 3.0])
    torch.testing.assert_close(policy(td.clone())["action"], plain * policy.action_gain)
    again = policy.plan_and_decode(td["observation_history"], noise)
    torch.testing.assert_close(again, decoded * policy.action_gain)


def test_a_command_is_held_back_with_its_gain():
    policy = policy_of(blend_decay=0.0)
    policy.leash = CommandLeash(0.25, commands=[0], positions=[1], actions=[2])
    policy.action_gain = torch.tensor([1.0, 1.0, 100.0, 1.0])
    assert (policy(observed())["action"][:, 2].abs() == 0.25).all()


def test_only_changes_of_a_command_have_one():
    assert make_gain(get_task("sorting"), 1) is None
    assert make_gain(get_task("stacking"), 1.5).tolist() == [1.5] * 7 + [1.0]  # the gripper opens as it did


def test_a_trained_policy_has_that_of_its_task_unless_told_otherwise(tmp_path):
    run = find_run("pretrained:stacking")  # its task has none
    assert load_policy(run).action_gain is None
    policy = load_policy(run, EvalConfig(action_gain=1.2))
    expected = torch.tensor([1.2] * 7 + [1.0])
    assert torch.equal(policy.action_gain, expected)
    saved = load_policy(save_policy(policy, tmp_path / "policy.safetensors"))
    assert torch.equal(saved.action_gain, expected)
    assert load_policy(tmp_path / "policy.safetensors", EvalConfig(action_gain=1.0)).action_gain is None


@pytest.mark.parametrize(("tracks", "controller", "gain"), [(False, "learned", True), (True, "learned", False)])
def test_those_who_know_what_they_commanded_go_without(tracks, controller, gain):
    task = get_task("po_sorting")
    own = task.defaults.execution["action_gain"]
    assert own > 1
    trained = SimpleNamespace(task=task, planner=object(), method=SimpleNamespace(tracks=tracks, keeps_posture=False))
    assert execution_of(trained, EvalConfig(controller=controller))["action_gain"] == (own if gain else 1.0)
    assert execution_of(trained, EvalConfig(controller="oracle"))["action_gain"] == 1.0
    assert execution_of(trained, EvalConfig(controller=controller, action_gain=1.4))["action_gain"] == 1.4


@pytest.mark.parametrize("gain", [0.0, -1.0, np.nan, np.inf])
def test_what_is_no_gain_is_refused(gain):
    with pytest.raises(ValueError, match="action_gain must be a number above 0, got"):
        make_gain(get_task("sorting"), gain)


def test_a_task_without_changes_of_a_command_has_none():
    with pytest.raises(ValueError, match="action_gain was given, but no action of task 'scooping' is a change"):
        make_gain(get_task("scooping"), 1.1)


def test_a_file_refuses_gains_that_it_cannot_hold(trained_run, tmp_path):
    policy = load_policy(trained_run)
    policy.action_gain = torch.tensor([1.2, 1.5])
    with pytest.raises(ValueError, match="a file holds one action_gain for all changes of a command"):
        save_policy(policy, tmp_path / "policy.safetensors")
    policy.action_gain = torch.ones(2)  # which is none
    assert load_policy(save_policy(policy, tmp_path / "policy.safetensors")).action_gain is None
