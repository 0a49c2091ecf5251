# This source code is licensed under the MIT license found in the LICENSE file.
"""The leash: a command stays near its robot, and an action that keeps it there is left alone."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from toy_policies import CountingPlanner, EchoController

from torchrl_koap import load_policy, save_policy
from torchrl_koap.evaluation import EvalConfig
from torchrl_koap.evaluation.rollouts import make_leash
from torchrl_koap.modules import CommandLeash, PlanThenControl
from torchrl_koap.runs.pretrained import find_run
from torchrl_koap.tasks import get_task

COLUMNS = {"commands": [0, 1], "positions": [2, 3], "actions": [0, 1]}


def seen(command, position, batch=()):
    frame = torch.tensor([*command, *position]).expand(*batch, 3, 4)
    return {"observation_history": frame.clone()}


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_command_ends_within_the_lead_on_every_axis(batch, dtype):
    td = TensorDict(seen((0.50, 0.30), (0.45, 0.38), batch), batch).to(dtype)
    td["action"] = torch.full((*batch, 3), 0.2, dtype=dtype)
    CommandLeash(0.1, **COLUMNS)(td)
    now = td["observation_history"][..., -1, :]
    ahead = now[..., :2] + td["action"][..., :2] - now[..., 2:]
    torch.testing.assert_close(ahead, torch.tensor([0.1, 0.1], dtype=dtype).expand(*batch, 2))
    assert (td["action"][..., 2] == 0.2).all()  # not one of the command's


def test_actions_within_the_lead_are_left_alone():
    action = 0.04 * torch.rand(1000, 2)
    td = TensorDict(seen((0.5, 0.3), (0.45, 0.33), [1000]) | {"action": action.clone()}, [1000])
    assert torch.equal(CommandLeash(0.1, **COLUMNS)(td)["action"], action)  # bit by bit


def test_a_blocked_robot_turns_back_as_soon_as_its_policy_does():
    def push(observed):  # forwards for 30 steps, then backwards
        return torch.tensor([0.01 if step < 30 else -0.01, 0.0])

    policy = TensorDictModule(push, in_keys=["observation_history"], out_keys=["action"])
    turned = {}
    for name, modules in {"free": [policy], "held": [policy, CommandLeash(0.05, **COLUMNS)]}.items():
        command, place = torch.zeros(2), torch.zeros(2)
        for step in range(60):
            td = TensorDict({"observation_history": torch.cat([command, place]).expand(1, 4)}, [])
            command = command + TensorDictSequential(*modules)(td)["action"]
            place = torch.minimum(place + 0.5 * (command - place), torch.tensor([0.02, 1.0]))  # a wall
            if step >= 30 and place[0] < 0.019 and name not in turned:
                turned[name] = step - 30
    assert turned["held"] <= 6 < 20 < turned["free"]


def test_a_task_says_which_columns_they_are():
    leash = make_leash(get_task("sorting"), 0.1)
    observation = torch.zeros(1, get_task("sorting").observation_dim)
    observation[:, :2] = 1.0  # the last command, a metre ahead
    td = TensorDict({"observation_history": observation, "action": torch.zeros(2)}, [])
    torch.testing.assert_close(leash(td)["action"], torch.tensor([-0.9, -0.9]))
    assert make_leash(get_task("sorting"), 0.0) is None


def test_a_policy_applies_its_own():
    policy = PlanThenControl(
        CountingPlanner(), EchoController(), state_columns=(0, 1), history=2, replan_interval=2, blend_decay=0.0
    )
    td = TensorDict({"observation_history": torch.ones(3, 2, 2), "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
    free = policy(td.clone())["action"]
    policy.leash = CommandLeash(0.25, commands=[0], positions=[1], actions=[2])
    held = policy(td.clone())["action"]
    assert (free[:, 2].abs() > 0.25).all() and (held[:, 2].abs() == 0.25).all()
    assert torch.equal(free[:, :2], held[:, :2])


def test_a_trained_policy_has_that_of_its_task_unless_told_otherwise(tmp_path):
    run = find_run("pretrained:sorting")
    policy = load_policy(run)
    assert policy.leash.lead == 0.1
    assert load_policy(run, EvalConfig(command_lead=0.0)).leash is None
    saved = load_policy(save_policy(policy, tmp_path / "policy.safetensors"))
    assert saved.leash.lead == 0.1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: CommandLeash(0.0, **COLUMNS), "lead must be above 0, got 0.0"),
        (lambda: CommandLeash(0.1, **COLUMNS | {"actions": [0]}), "2, 2 and 1 columns"),
        (lambda: make_leash(get_task("scooping"), 0.1), "command_lead was given, but the actions of task 'scooping'"),
        (lambda: make_leash(get_task("sorting"), -0.1), "command_lead must be a number >= 0, got -0.1"),
        (lambda: make_leash(get_task("sorting"), float("inf")), "command_lead must be a number >= 0, got inf"),
    ],
)
def test_what_holds_nothing_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
