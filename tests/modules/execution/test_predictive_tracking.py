# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans that are followed by prediction: on a robot whose response is known, and as a policy."""

import copy

import pytest
import torch
from tensordict import TensorDict

from torchrl_koap.modules import (
    CommandResponse,
    MLPDenoiser,
    PlanThenControl,
    PredictiveTracking,
    StatePlanner,
    make_koopman_inverse_dynamics,
)


def sluggish() -> CommandResponse:
    """Two axes that follow their commands late, one of them slower."""
    response = CommandResponse([0, 1], [0, 1], [0, 1])
    response.weight[[0, 1], [0, 1], 0] = torch.tensor([0.8, 0.6])
    response.weight[[0, 1], [0, 1], 2] = torch.tensor([0.05, 0.1])
    response.weight[[0, 1], [0, 1], 3] = torch.tensor([0.2, 0.1])
    return response


def policy_of(response=None, kind=PredictiveTracking, **options):
    torch.manual_seed(0)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8, depth=1), state_dim=2, num_steps=2)
    controller = make_koopman_inverse_dynamics(2, 2)
    args = (planner, controller) if kind is PlanThenControl else (planner, controller, response or sluggish())
    return kind(*args, state_columns=(2, 3), history=5, **options).eval()


def follow(policy: PredictiveTracking, path: torch.Tensor) -> torch.Tensor:
    """Positions of a robot that answers as ``sluggish`` while ``path [T, 2]`` is tracked: ``[steps, 2]``."""
    robot, size = sluggish(), policy.look_ahead
    x, c, a = torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(2, 2)
    been = []
    for step in range(len(path) - size):
        observed = torch.cat([c, x], -1)
        change = policy.track(observed, x, path[step + 1 : step + 1 + size])[0]
        if policy.response.absolute:
            change = change - c[-1]
        moved = robot.predict(x[-3:], c[-1], a, torch.zeros(1, 2))
        x, c = torch.cat([x[1:], moved]), torch.cat([c[1:], c[-1:] + change])
        a = torch.cat([a[1:], change.unsqueeze(0)])
        been.append(moved[0])
    return torch.stack(been)


@pytest.mark.parametrize("absolute", [False, True])
def test_a_known_robot_stays_on_the_path(absolute):
    time = torch.linspace(0, 3, 80)
    path = torch.stack([0.1 * (1 - time.cos()), 0.05 * time * time.sin()], -1)
    response = sluggish()
    response.absolute = absolute
    policy = policy_of(response, smoothness=0.1, blend_decay=0.0)
    been = follow(policy, path)
    error = (been - path[1 : len(been) + 1]).norm(dim=-1)
    assert error[10:].max() < 1e-3  # m; executing the path as commands leaves most of a centimetre
    behind = sluggish().predict(torch.zeros(3, 2), torch.zeros(2), torch.zeros(2, 2), path.diff(dim=0))
    assert (behind[: len(been)] - path[1 : len(been) + 1]).norm(dim=-1)[10:].max() > 5e-3


def test_smooth_commands_are_bought_with_distance():
    time = torch.linspace(0, 3, 60)
    path = torch.stack([0.1 * (8 * time).sin(), 0 * time], -1)
    errors = []
    for smoothness in (0.1, 100.0):
        been = follow(policy_of(smoothness=smoothness), path)
        errors.append((been - path[1 : len(been) + 1]).pow(2).mean())
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_tracked_entries_are_replaced_and_others_decoded(batch):
    one_axis = CommandResponse([1], [1], [1])
    one_axis.weight[0, 0, 2] = 0.3
    policy, decoded = policy_of(one_axis), policy_of(kind=PlanThenControl)
    decoded.load_state_dict({k: v for k, v in policy.state_dict().items() if not k.startswith("response.")})
    observed = TensorDict(
        {
            "observation_history": torch.randn(*batch, 5, 4),
            "is_init": torch.ones(*batch, 1, dtype=torch.bool),
            "noise": torch.randn(*batch, *policy.noise_shape),
        },
        batch,
    )
    policy.planner.noise_key = decoded.planner.noise_key = "noise"
    mine, theirs = policy(observed.clone()), decoded(observed.clone())
    torch.testing.assert_close(mine["action"][..., 0], theirs["action"][..., 0])
    wanted = policy.track(
        observed["observation_history"], policy.state_of(observed["observation_history"]), mine["remaining_plan"]
    )
    torch.testing.assert_close(mine["action"][..., 1:], wanted[..., 0, :])
    assert not torch.allclose(mine["action"][..., 1], theirs["action"][..., 1])


def test_chunks_for_export_begin_with_the_action_of_the_step():
    policy = policy_of()
    observed, noise = torch.randn(3, 5, 4), torch.randn(3, *policy.noise_shape)
    chunk = policy.plan_and_decode(observed, noise)
    assert chunk.shape == (3, 4, 2)
    policy.planner.noise_key = "noise"
    td = TensorDict({"observation_history": observed, "is_init": torch.ones(3, 1, dtype=torch.bool), "noise": noise}, 3)
    torch.testing.assert_close(policy(td)["action"], chunk[:, 0])
    states = policy.state_of(observed)
    plan = policy.planner.sample(states[:, -policy.planner.history :], noise)
    torch.testing.assert_close(chunk, policy.track(observed, states, plan)[:, :4])
    assert not torch.allclose(chunk[:, 0], chunk[:, 1])
    policy.action_gain = torch.tensor([2.0, 2.0])
    torch.testing.assert_close(policy.plan_and_decode(observed, noise), 2 * chunk)


def test_options_out_of_range_are_refused():
    with pytest.raises(ValueError, match="execution must be 'feedback', got 'open_loop'"):
        policy_of(execution="open_loop")
    with pytest.raises(ValueError, match="look_ahead must be 2 to 14"):
        policy_of(look_ahead=15)
    with pytest.raises(ValueError, match="smoothness must be > 0"):
        policy_of(smoothness=0.0)
    with pytest.raises(ValueError, match="reads 6 observed frames, history is only 5"):
        policy_of(CommandResponse([0, 1], [0, 1], [0, 1], memory=5))


def test_actions_minimise_what_is_documented():
    torch.manual_seed(0)
    policy = policy_of(look_ahead=4, smoothness=2.0, end_speed=3.0, blend_decay=0.0)
    observed, plan = torch.randn(5, 4).double(), torch.randn(14, 2).double()
    states, changes = observed[:, 2:], observed[-3:, :2].diff(dim=0)

    def cost(future):
        held = torch.cat([future, future.new_zeros(1, 2)])  # the last change is not seen
        y = policy.response.predict(states[-3:], observed[-1, :2], changes, held)
        jerk = torch.cat([changes[-1:], future]).diff(dim=0)
        speed = (y[-1] - y[-2]) - (plan[3] - plan[2])
        return (y - plan[:4]).pow(2).sum() + 9.0 * speed.pow(2).sum() + 2.0 * jerk.pow(2).sum()

    best = policy.track(observed, states, plan).requires_grad_()
    assert best.shape == (3, 2)
    (slope,) = torch.autograd.grad(cost(best), best)
    torch.testing.assert_close(slope, torch.zeros_like(slope), atol=1e-9, rtol=0)


@pytest.mark.parametrize("whole", [True, False], ids=["of the policy", "of the response alone"])
def test_weights_that_are_loaded_later_count(whole):
    policy, other = policy_of(), sluggish()
    other.weight[[0, 1], [0, 1], 2] *= 3
    wanted = policy_of(other)
    copied = copy.deepcopy(policy)
    before = [gain.clone() for gain in policy.gains()]
    if whole:
        policy.load_state_dict(wanted.state_dict())
    else:
        policy.response.load_state_dict(other.state_dict())
    for now, expected, earlier in zip(policy.gains(), wanted.gains(), before, strict=True):
        torch.testing.assert_close(now, expected)
        assert not torch.allclose(now, earlier)
    for mine, earlier in zip(copied.gains(), before, strict=True):  # a copy goes on with weights of its own
        torch.testing.assert_close(mine, earlier)
    copied.load_state_dict(wanted.state_dict())
    torch.testing.assert_close(copied.gains()[0], wanted.gains()[0])


def test_a_response_that_is_fitted_again_is_tracked_by_its_new_weights():
    policy = policy_of()
    before = policy.gains()[0].clone()
    policy.response.weight.mul_(0.5)
    after = policy.gains()[0]
    assert not torch.equal(before, after)
    torch.testing.assert_close(after, policy_of(copy.deepcopy(policy.response)).gains()[0])


@pytest.mark.parametrize("absolute", [False, True])
def test_chunks_longer_than_the_look_ahead_hold_the_last_command(absolute):
    response = sluggish()
    response.absolute = absolute
    policy = policy_of(response, look_ahead=3)  # tells two actions of the four that are executed
    observations, noise = torch.randn(1, 5, 4), torch.randn(1, 14, 2)
    chunk = policy.plan_and_decode(observations, noise)
    assert chunk.shape == (1, 4, 2)
    held = chunk[:, 1] if absolute else torch.zeros(1, 2)
    torch.testing.assert_close(chunk[:, 2:], held.unsqueeze(1).expand(-1, 2, -1))
