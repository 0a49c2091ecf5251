# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests plan followers: blending with the present state, decoding, and a final rule for actions."""

import pytest
import torch
from toy_policies import CountingPlanner, EchoController

from torchrl_koap.modules import (
    MPC,
    Execution,
    ResponseModel,
    blend_plan,
    make_koopman_inverse_dynamics,
    make_policy,
)
from torchrl_koap.modules.execution.followers import InverseDynamicsFollower, command_rest, remaining_plan
from torchrl_koap.modules.windows import StateReader
from torchrl_koap.tasks.action_rules import ActionRule


def test_a_blended_plan_leaves_from_the_present_state_and_ends_as_planned():
    line = torch.stack([torch.arange(1.0, 15.0), 2 * torch.arange(1.0, 15.0)], -1)  # at (0, 0) at present
    history = torch.tensor([[9.0, 9.0], [5.0, -3.0]])
    blended = blend_plan(history, line, 0.8)
    for k in range(14):
        torch.testing.assert_close(blended[k], line[k] + 0.8 ** (k + 1) * history[-1])
    torch.testing.assert_close(blend_plan(torch.zeros(2, 2), line, 0.8), line)  # a plan that fits is left as it is
    assert torch.equal(blend_plan(history, line, 0.0), line)
    batched = blend_plan(history.expand(3, 4, 2, 2), line.expand(3, 4, 14, 2), 0.8)
    torch.testing.assert_close(batched[2, 3], blended)
    short = torch.tensor([[1.0], [5.0], [3.0], [4.0]])
    assert torch.equal(blend_plan(torch.tensor([[1.0]]), short, 0.5), short)


def test_a_plan_that_accelerates_from_the_present_state_is_left_as_it_is():
    time = torch.arange(1.0, 15.0)[:, None]
    accelerating = torch.tensor([2.0, -1.0]) + time * torch.tensor([0.5, 0.0]) + time**2 * torch.tensor([0.1, -0.3])
    torch.testing.assert_close(blend_plan(torch.tensor([[2.0, -1.0]]), accelerating, 0.8), accelerating)
    parabola = torch.linalg.lstsq(time[:5] ** torch.arange(3), torch.tensor([[1.0], [0.0], [3.0], [0.0], [1.0]]))
    rough = torch.tensor([[1.0], [0.0], [3.0], [0.0], [1.0]])
    torch.testing.assert_close(blend_plan(parabola.solution[:1], rough, 0.5), rough)  # least squares, at present


def test_the_final_rule_for_actions_reads_the_whole_window():
    seen = []

    def rule(states, actions):
        seen.append(states)
        return actions + 0.5

    follower = InverseDynamicsFollower(EchoController(), reads=StateReader((1, 0)), action_rule=rule)
    states = torch.tensor([[[3.0, 7.0], [4.0, 8.0]]])
    plan = CountingPlanner().sample(states + 5.0)  # of a robot that is elsewhere by now
    assert follower(states, states, plan)[0, 0, :2].tolist() == [7.5, 8.5]
    assert seen[0][0, :, 0].tolist() == [3, 4] + [9 + 1000.0 * k for k in range(1, 7)]  # plans as they were made


def test_actions_are_followed_whichever_entries_the_controller_was_asked_to_write():
    controller, states, plan = make_koopman_inverse_dynamics(2, 2), torch.randn(3, 5, 2), torch.randn(3, 14, 2)
    expected = InverseDynamicsFollower(controller)(states, states, plan)
    selected = InverseDynamicsFollower(controller.select_out_keys("action", "latent_action"))
    assert torch.equal(selected(states, states, plan), expected)
    with pytest.raises(KeyError, match='"action" not found'):
        InverseDynamicsFollower(controller.select_out_keys("latent_action"))(states, states, plan)


def test_the_last_state_stays_when_a_plan_is_over():
    plan = torch.arange(8.0).reshape(2, 4, 1)
    assert remaining_plan(plan, 2)[:, :, 0].tolist() == [[2, 3, 3, 3], [6, 7, 7, 7]]
    assert remaining_plan(plan, torch.tensor([0, 9]))[:, :, 0].tolist() == [[0, 1, 2, 3], [7, 7, 7, 7]]


@torch.no_grad()
def test_a_gripper_is_commanded_by_the_planned_widths():
    def opened(states, plan):
        return command_rest(ActionRule((2, 1)), states, plan, 3, 1)[0, 0]

    states, plan = torch.zeros(1, 5, 2), torch.zeros(1, 14, 2)
    plan[:, :, 1] = torch.linspace(0.01, 0.08, 14)
    assert opened(states, plan)[2] < 0.075  # it opens much later
    plan[:, :, 1] = torch.linspace(0.05, 0.08, 14)
    assert opened(states, plan)[2] == pytest.approx(0.05)
    states[..., 1], plan[:, :, 1] = 0.08, torch.linspace(0.06, 0.03, 14)
    assert opened(states, plan).tolist() == [0, 0, plan[0, 0, 1]]
    assert not command_rest(None, states, plan, 3, 4).any()


CONTROLLERS = {
    InverseDynamicsFollower: EchoController,
    MPC: lambda: ResponseModel([0, 1], [0, 1], [0, 1]),
}


@pytest.mark.parametrize("kind", CONTROLLERS)
def test_the_factory_knows_how_a_controller_is_followed(kind):
    execution = Execution(replan_interval=2, blend=0.3)
    policy = make_policy(CountingPlanner(), CONTROLLERS[kind](), state_of=(0, 1), execution=execution)
    assert type(policy.follower) is kind and policy.follower.blend == 0.3 and policy.execution == execution
    assert policy.limits is None and not policy.training
    knows = kind is not InverseDynamicsFollower
    assert policy.follower.knows_command is knows
    for asked, named in {"strategy": "open_loop", "gain": 1.5}.items():
        if knows:
            with pytest.raises(ValueError, match=f"{kind.__name__} .*{asked}"):
                make_policy(
                    CountingPlanner(),
                    CONTROLLERS[kind](),
                    state_of=(0, 1),
                    changes=(0, 1),
                    execution=execution.replaced(**{asked: named}),
                )
