# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans followed by the commands of their states: what is not seen is kept where it belongs."""

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.evaluation.rollouts import make_policy
from torchrl_koap.modules import CommandPosture, MLPDenoiser, PostureTracking, StatePlanner
from torchrl_koap.modules import make_koopman_inverse_dynamics as make_controller
from torchrl_koap.modules.execution.posture_tracking import PULL
from torchrl_koap.tasks.action_rules import ActionRule


class Known(CommandPosture):
    """Two commands of a state ``x, width``: the first moves x, the second ought to be twice x and is not seen."""

    def __init__(self, **options):
        super().__init__(2, [0, 1], [0, 1], width=4, **options)

    def forward(self, states):
        return torch.stack([states[..., 0], 2 * states[..., 0]], -1)


def policy_of(posture=None, **options) -> PostureTracking:
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2, num_steps=2)
    return PostureTracking(
        planner, make_controller(2, 3), posture or Known(), state_columns=(3, 4), history=5, **options
    ).eval()


def test_a_joint_that_is_not_seen_comes_back():
    policy, command, x = policy_of(), torch.tensor([0.0, 1.5]), torch.zeros(2)
    plan = torch.stack([torch.linspace(0.01, 0.14, 14), torch.zeros(14)], -1)
    for _ in range(40):
        command = command + policy.follow(x, command, plan - plan[:1] + x + torch.tensor([0.01, 0.0]))[0]
        x = torch.stack([command[0], x[1]])  # what is seen follows the first command
    assert x[0] == pytest.approx(0.4, abs=1e-4)
    assert command[1] == pytest.approx(0.8, abs=1e-3)  # it began 1.5 away


def test_without_pull_it_stays_where_it_strayed():
    policy = policy_of(pull=0.0)
    still = torch.zeros(14, 2)
    assert policy.follow(torch.zeros(2), torch.tensor([0.0, 1.5]), still).abs().max() == 0


def test_several_steps_sum_up_to_the_posture_at_the_end():
    policy = policy_of()
    plan = torch.randn(3, 6, 2)
    now = torch.randn(3, 2)
    changes = policy.follow(now, policy.posture(now), plan)
    torch.testing.assert_close(policy.posture(now) + changes.sum(-2), policy.posture(plan[:, -1]))


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_as_a_policy_of_any_batch(batch):
    policy = policy_of()
    td = TensorDict({"observation_history": torch.randn(*batch, 5, 5), "is_init": torch.ones(*batch, 1).bool()}, batch)
    action = policy(td)["action"]
    assert action.shape == (*batch, 3)
    plain = policy_of(pull=0.0)
    noise = td.select("observation_history", "is_init")
    torch.manual_seed(1)
    drawn = policy(noise.clone())["action"]
    torch.manual_seed(1)
    free = plain(noise.clone())["action"]
    assert torch.equal(drawn[..., 2], free[..., 2])  # decoded by the controller
    assert not torch.equal(drawn[..., :2], free[..., :2])


def test_the_first_of_several_decoded_steps_is_the_action_of_the_step():
    policy = policy_of()
    observed, noise = torch.randn(3, 5, 5), torch.randn(3, *policy.noise_shape)
    td = TensorDict({"observation_history": observed, "is_init": torch.ones(3, 1).bool(), "planner_noise": noise}, [3])
    td = td.rename_key_("planner_noise", policy.planner.noise_key)
    chunk = policy.plan_and_decode(observed, noise)
    assert chunk.shape == (3, policy.replan_interval, 3)
    torch.testing.assert_close(chunk[:, 0], policy(td)["action"])


@torch.no_grad()
def test_a_gripper_is_commanded_by_the_planned_widths():
    policy = policy_of(Known(gripper=(2, 1)), action_rule=ActionRule((2, 1)))
    history, plan = torch.zeros(1, 5, 2), torch.zeros(1, 14, 2)
    plan[:, :, 1] = torch.linspace(0.01, 0.08, 14)
    assert policy.act(history, plan)[0, 2] < 0.075  # it opens much later
    plan[:, :, 1] = torch.linspace(0.05, 0.08, 14)
    assert policy.act(history, plan)[0, 2] == pytest.approx(0.05)
    history[..., 1], plan[:, :, 1] = 0.08, torch.linspace(0.06, 0.03, 14)
    assert policy.act(history, plan)[0, 2] == plan[0, 0, 1]


def test_a_controller_with_a_posture_has_the_rule_of_its_gripper():
    controller = make_controller(2, 3)
    controller.posture = Known(gripper=(2, 1))
    policy = make_policy(policy_of().planner, controller, state_columns=(3, 4))
    assert isinstance(policy, PostureTracking) and policy.action_rule == ActionRule((2, 1))


@pytest.mark.parametrize(
    ("options", "named"), [({"pull": 1.5}, "pull"), ({"pull": -0.1}, "pull"), ({"execution": "open_loop"}, "execution")]
)
def test_options_are_refused_by_name(options, named):
    with pytest.raises(ValueError, match=named):
        policy_of(**options)


def test_the_pull_has_a_default():
    assert policy_of().pull == PULL
