# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the response to commands: fitting it, and following plans with it."""

import pytest
import torch
from small_networks import a_system
from tensordict import TensorDict

from torchrl_koap.modules import MPC, Execution, MLPDenoiser, ResponseModel, StatePlanner, blend_plan, make_policy

AXES = 2


def coupled_system() -> ResponseModel:
    system = a_system()
    system.weight[1, 0, 3] = -0.1  # the second axis is moved by the first command
    return system


def steps_of(system: ResponseModel, count: int = 2000) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    read = torch.randn(count, AXES, 5, dtype=torch.float64)
    return read, torch.einsum("jkf,nkf->nj", system.weight, read)


def test_a_fit_finds_the_system():
    system = coupled_system()
    fitted = ResponseModel([0, 1], [0, 1], [0, 1]).double().fit_ridge(*steps_of(system), penalty=1e-12)
    torch.testing.assert_close(fitted.weight, system.weight, atol=1e-5, rtol=0)


def test_uncoupled_axes_have_no_cross_weights():
    fitted = (
        ResponseModel([0, 1], [0, 1], [0, 1])
        .double()
        .fit_ridge(*steps_of(coupled_system()), penalty=1e-12, coupled=False)
    )
    assert not fitted.weight[0, 1].any() and not fitted.weight[1, 0].any()
    torch.testing.assert_close(fitted.weight[0, 0], coupled_system().weight[0, 0], atol=1e-2, rtol=0)


def test_a_penalty_is_relative_to_the_number_of_steps_and_a_still_coordinate_has_no_weight():
    read, steps = steps_of(coupled_system(), count=50)
    read[:, 0, 3] = 0.0
    fits = [
        ResponseModel([0, 1], [0, 1], [0, 1]).double().fit_ridge(read.repeat(n, 1, 1), steps.repeat(n, 1), penalty=0.5)
        for n in (1, 2)
    ]
    torch.testing.assert_close(fits[1].weight, fits[0].weight)
    assert fits[0].weight[:, 0, 2].abs().min() > 0 and not fits[0].weight[:, 0, 3].any()


def test_impulses_add_up_to_the_prediction():
    system, steps = coupled_system(), 6
    changes = torch.randn(steps, AXES, dtype=torch.float64)
    nothing = torch.zeros(3, AXES, dtype=torch.float64)
    wanted = system.predict(nothing, nothing[0], nothing[1:], changes)
    matrix = system.impulse_matrix(steps)
    assert matrix.shape == (steps, AXES, steps - 1, AXES)
    torch.testing.assert_close(torch.einsum("njka,ka->nj", matrix, changes[:-1]), wanted)
    assert not matrix[0].any()  # what is commanded now is not in the next measurement


def test_bad_columns_and_intervals_are_refused():
    with pytest.raises(ValueError, match="'commands': 1"):
        ResponseModel([0, 1], [0], [0, 1])
    with pytest.raises(ValueError, match="look_ahead must be at least 2, got .*: lower replan_interval"):
        policy_of(replan_interval=14)
    assert [policy_of(replan_interval=steps).follower.look_ahead for steps in (1, 13)] == [14, 2]


def mpc_of(response=None, look_ahead=11, **options):
    return MPC(response or a_system().float(), look_ahead=look_ahead, **options)


def policy_of(response=None, **execution):
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8), state_dim=2, num_steps=2)
    return make_policy(
        planner, response or a_system().float(), state_of=(2, 3), changes=(0, 1), execution=Execution(**execution)
    )


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_actions_outside_the_response_come_from_the_rule(batch):
    one_axis = ResponseModel([1], [1], [1], action_dim=3)
    one_axis.weight[0, 0, 2] = 0.3
    mpc = mpc_of(one_axis, action_rule=lambda states, actions: actions + states[..., :1])
    observed, plan = torch.randn(*batch, 5, 4), torch.randn(*batch, 14, 2)
    states = observed[..., 2:]
    actions = mpc(observed, states, plan, 2)
    assert actions.shape == (*batch, 2, 3)
    torch.testing.assert_close(actions[..., 1:2], mpc.track(observed, states, plan)[..., :2, :])
    for column in (0, 2):  # the states of the frames: the present one and the next planned one
        torch.testing.assert_close(actions[..., 0, column], states[..., -1, 0])
        torch.testing.assert_close(actions[..., 1, column], plan[..., 0, 0])


def test_chunks_for_export_begin_with_the_action_of_the_step():
    policy = policy_of()
    assert policy.history == 3
    observed, noise = torch.randn(3, 3, 4), torch.randn(3, *policy.noise_shape)
    chunk, _ = policy.decode_ahead(observed, noise)
    assert chunk.shape == (3, 4, 2)
    td = TensorDict({"observation_history": observed, "is_init": torch.ones(3, 1, dtype=torch.bool), "noise": noise}, 3)
    torch.testing.assert_close(policy(td)["action"], chunk[:, 0])
    states = policy.state_of(observed)
    plan = policy.planner.sample(states[:, -policy.planner.history :], noise)
    torch.testing.assert_close(chunk, policy.follower.track(observed, states, plan)[:, :4])
    assert not torch.allclose(chunk[:, 0], chunk[:, 1])


def test_the_plan_is_blended_into_the_present_state_first():
    observed, plan = torch.randn(3, 5, 4), torch.randn(3, 14, 2)
    states = observed[..., 2:]
    found = mpc_of(blend=0.5).track(observed, states, plan)
    torch.testing.assert_close(found, mpc_of(blend=0.0).track(observed, states, blend_plan(states, plan, 0.5)))
    assert not torch.allclose(found, mpc_of(blend=0.0).track(observed, states, plan))


@pytest.mark.parametrize("absolute", [False, True])
def test_actions_minimise_what_is_documented(absolute):
    torch.manual_seed(0)
    mpc = mpc_of(look_ahead=4, blend=0.0)
    mpc.controller.absolute = absolute
    observed, plan = torch.randn(5, 4).double(), torch.randn(14, 2).double()
    states, changes = observed[:, 2:], observed[-3:, :2].diff(dim=0)

    def cost(future):
        held = torch.cat([future, future.new_zeros(1, 2)])  # the last change is not seen
        y = mpc.controller.predict(states[-3:], observed[-1, :2], changes, held)
        jerk = torch.cat([changes[-1:], future]).diff(dim=0)
        speed = (y[-1] - y[-2]) - (plan[3] - plan[2])
        return (y - plan[:4]).pow(2).sum() + 5.0**2 * speed.pow(2).sum() + 3.0 * jerk.pow(2).sum()

    best = mpc.track(observed, states, plan)
    best = (torch.cat([observed[-1:, :2], best]).diff(dim=0) if absolute else best).requires_grad_()
    assert best.shape == (3, 2)
    (slope,) = torch.autograd.grad(cost(best), best)
    torch.testing.assert_close(slope, torch.zeros_like(slope), atol=1e-9, rtol=0)


def test_weights_that_are_loaded_later_count():
    mpc, other = mpc_of(), a_system().float()
    other.weight[[0, 1], [0, 1], 2] *= 3
    wanted, before = mpc_of(other), mpc.follow_gain.clone()
    mpc.load_state_dict(wanted.state_dict())
    assert torch.equal(mpc.follow_gain, wanted.follow_gain) and not torch.allclose(mpc.follow_gain, before)
    mpc.controller.weight.copy_(a_system().float().weight)
    mpc.refresh()
    torch.testing.assert_close(mpc.follow_gain, before)


@pytest.mark.parametrize("absolute", [False, True])
def test_steps_beyond_the_look_ahead_hold_the_last_command(absolute):
    response = a_system().float()
    response.absolute = absolute
    mpc = mpc_of(response, look_ahead=3)  # tells two actions
    observed = torch.randn(1, 5, 4)
    chunk = mpc(observed, observed[..., 2:], torch.randn(1, 14, 2), 4)
    assert chunk.shape == (1, 4, 2)
    held = chunk[:, 1] if absolute else torch.zeros(1, 2)
    torch.testing.assert_close(chunk[:, 2:], held.unsqueeze(1).expand(-1, 2, -1))
