# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests which frame of which plan is used at each step, against a reference loop."""

import pickle

import pytest
import torch
from small_networks import chunk_policy, small_planner
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from toy_policies import CountingPlanner, CountingSampler, EchoController, EpisodesOfRandomLength, state_number

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.modules import (
    Execution,
    PlanningPolicy,
    PolicyEnv,
    ResponseModel,
    make_koopman_inverse_dynamics,
    make_policy,
    policy_transforms,
)
from torchrl_koap.modules.execution.followers import InverseDynamicsFollower

LENGTHS = ((5, 3, 11), (9,), (1, 2, 7, 4), (12, 6), (4, 4, 8))
KINDS = ["feedback", "open_loop", "chunks"]


def policy_of(kind="feedback", interval=4, columns=(1, 2), num_past=1, **options):
    """A counting policy; the reference loop decodes plans as they are."""
    execution = Execution("open_loop" if kind == "chunks" else kind, replan_interval=interval, blend=0.0)
    if kind == "chunks":
        return PlanningPolicy(CountingSampler(), state_of=columns, execution=execution, **options)
    follower = InverseDynamicsFollower(EchoController(num_past), blend=0.0)
    return PlanningPolicy(CountingPlanner(), follower, state_of=columns, execution=execution, **options)


def expected_action(env, episode, step, interval, kind):
    """Written from the picture in the docstring of Execution, one step at a time."""

    def x(at):
        return state_number(env, episode % 5, at)

    planned_at = step - step % interval
    age = step - planned_at
    if kind == "chunks":
        return [float(age), x(planned_at), x(max(planned_at - 1, 0)), 7.0]
    following = [x(planned_at) + 1000 * (age + 1), x(planned_at)]  # frame `age` of the plan, and where it was made
    if kind == "feedback":
        return [x(max(step - 1, 0)), x(step), *following]
    if age == 0:
        return [x(max(planned_at - 1, 0)), x(planned_at), *following]
    before = x(planned_at) + 1000 * (age - 1) if age > 1 else x(planned_at)
    return [before, x(planned_at) + 1000 * age, *following]


class OneColumn(CountingPlanner):
    def sample(self, history, noise=None):
        return super().sample(history)[..., :1]


def test_a_plan_of_fewer_columns_is_not_broadcast():
    policy = PlanningPolicy(OneColumn(), InverseDynamicsFollower(EchoController(1), blend=0.0), state_of=(1, 2))
    with pytest.raises(ValueError, match=r"a plan must be \[3, 6, 2\] .*, got \[3, 6, 1\]"):
        policy.sample(torch.randn(3, 2, 2))


def step_input(observed, **more):
    batch = observed.shape[:-2]
    init = torch.ones(*batch, 1, dtype=torch.bool)
    return TensorDict({"observation_history": observed, "is_init": init, **more}, batch)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("interval", [1, 4, 6])
@pytest.mark.parametrize("num_envs", [1, 5])
def test_every_action_in_a_collector_with_auto_reset(kind, interval, num_envs):
    env = TransformedEnv(EpisodesOfRandomLength(num_envs, LENGTHS), policy_transforms(2))
    policy = policy_of(kind, interval)
    steps = 45
    collector = Collector(env, policy, frames_per_batch=15 * num_envs, total_frames=steps * num_envs)
    policy.planner.calls.clear()  # the collector tries the policy once
    data = torch.cat([batch.clone() for batch in collector], 1)
    collector.shutdown()
    assert data.shape == (num_envs, steps)
    for index in range(num_envs):
        episode, step = 0, 0
        while data["observation"][index, 0, 1] != state_number(index, episode, 0):
            episode += 1  # the collector resets once more before it begins
        plans = 0
        for row in range(steps):
            now, before = (state_number(index, episode % 5, max(step - back, 0)) for back in (0, 1))
            assert data["observation"][index, row, 1] == now
            expected = expected_action(index, episode, step, interval, kind)
            assert data["action"][index, row].tolist() == expected, (index, episode, step)
            assert data["observation_history"][index, row, :, 1].tolist() == [before, now]
            plans += step % interval == 0
            step += 1
            if data["next", "done"][index, row]:
                episode, step = episode + 1, 0
        made = sum(int(number // 100) == index for call in policy.planner.calls for number in call)
        assert made == plans  # the planner runs for rows that need a plan, and for no others


@pytest.mark.parametrize("kind", ["feedback", "open_loop"])
def test_longer_histories_reach_the_follower_shorter_ones_the_planner(kind):
    policy = policy_of(kind, num_past=4)
    assert policy.history == 5 and policy_of("chunks").history == 2
    td = policy(step_input(torch.arange(15.0).reshape(1, 5, 3)))
    assert policy.planner.calls == [[13.0]]
    assert td["action"].tolist() == [[10.0, 13.0, 1013.0, 13.0]]


@pytest.mark.parametrize("kind", KINDS)
def test_renamed_keys(kind):
    policy = policy_of(kind, history_key=("agent", "frames"), action_key=("agent", "command"))
    expected, observed = policy_of(kind), torch.rand(3, 2, 3)
    renamed = TensorDict({"agent": {"frames": observed}, "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
    plain = step_input(observed)
    for _ in range(6):
        renamed, plain = policy(renamed), expected(plain)
        assert torch.equal(renamed["agent", "command"], plain["action"])
        assert set(policy.out_keys) <= set(renamed.keys(True))
        for td in (renamed, plain):
            td["is_init"] = torch.zeros(3, 1, dtype=torch.bool)
    assert list(policy.in_keys) == [("agent", "frames"), "is_init"]


@pytest.mark.parametrize("kind", KINDS)
def test_policies_of_two_arms_in_one_sequence_keep_plans_of_their_own(kind):
    alone = [policy_of(kind, interval) for interval in (4, 3)]
    arms = [policy_of(kind, each, action_key=(arm, "action")) for arm, each in {"left": 4, "right": 3}.items()]
    both, together, apart = TensorDictSequential(*arms), TensorDict(batch_size=[2]), [TensorDict(batch_size=[2])] * 2
    for step in range(9):
        given = step_input(torch.rand(2, 2, 3)).set("is_init", torch.tensor([[step == 0], [step in (0, 5)]]))
        together = both(together.update(given))
        apart = [policy(td.copy().update(given)) for policy, td in zip(alone, apart, strict=True)]
        for arm, td in zip(("left", "right"), apart, strict=True):
            assert torch.equal(together[arm, "action"], td["action"]), (arm, step)


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match=r"replan_interval must be in 1..6 \(the horizon\), got 7"):
        policy_of(interval=7)
    with pytest.raises(ValueError, match=r"must have at least 3 columns \(state_of\), got 2"):
        policy_of()(step_input(torch.zeros(1, 2, 2)))


def test_a_missing_transform_is_named():
    with pytest.raises(KeyError, match="reads 'observation_history': use PolicyEnv"):
        EpisodesOfRandomLength(2, LENGTHS).rollout(2, policy_of())
    with pytest.raises(KeyError, match="reads 'is_init': use PolicyEnv"):
        policy_of()(TensorDict({"observation_history": torch.zeros(2, 2, 3)}, [2]))
    with pytest.raises(ValueError, match=r"must be \[2, 2, 'obs'\] .*, got \[2, 4, 3\]"):
        policy_of()(step_input(torch.zeros(2, 4, 3)))
    agents = TensorDict({"observation_history": torch.zeros(2, 5, 2, 3), "is_init": torch.ones(2, 1).bool()}, [2])
    with pytest.raises(ValueError, match=r"must be \[2, 2, 'obs'\] .*, got \[2, 5, 2, 3\]"):
        policy_of()(agents)  # five agents would be five frames of a plan


@pytest.mark.parametrize("elsewhere", [1, 2])
def test_a_plan_that_is_lost_is_that_of_another_environment_if_the_policy_acted_there(elsewhere):
    policy = policy_of()

    def act(count, number, begins):
        seen = [float(max(number - back, number // 100 * 100)) for back in (1, 0)]
        frames = torch.stack([torch.full((count, 3), each) for each in seen], 1)
        return policy(step_input(frames).set("is_init", torch.full((count, 1), begins)))["action"][0, 3].item()

    assert [act(2, 0, True), act(2, 1, False)] == [0, 0]  # the state in which the plan was made
    assert [act(elsewhere, 100, True), act(elsewhere, 101, False)] == [100, 100]
    assert [act(2, 2, False), act(2, 3, False)] == [2, 2]


@pytest.mark.parametrize(("entry", "planned"), [("is_init", [[101.0]]), ("_step", [])])
def test_a_row_that_begins_or_waits_does_not_make_the_others_plan_anew(entry, planned):
    policy, frames = policy_of(), torch.arange(2.0)[:, None, None].expand(2, 2, 3)
    policy(step_input(frames).set("is_init", torch.ones(2, 1, dtype=torch.bool)))
    later = step_input(torch.stack([frames[0], frames[1] + 100])).set("is_init", torch.zeros(2, 1, dtype=torch.bool))
    policy(later.set(entry, torch.tensor([[entry == "_step"], [entry == "is_init"]])))
    assert policy.planner.calls[1:] == planned


def test_planned_states_are_not_executed_nor_sampled_actions_decoded():
    with pytest.raises(ValueError, match="StatePlanner samples states: a controller must decode them"):
        make_policy(small_planner(), state_of=(2, 3))
    actions = chunk_policy().planner
    with pytest.raises(ValueError, match="DiffusionPolicy samples actions: no controller may decode them"):
        make_policy(actions, make_koopman_inverse_dynamics(2, 2), state_of=(2, 3))


def test_an_inverse_dynamics_reads_what_it_is_told_to_and_a_new_policy_is_in_evaluation_mode():
    options = {"state_of": (0, 1, 2, 3), "reads": lambda states: states[..., 2:]}
    policy = make_policy(small_planner(4), make_koopman_inverse_dynamics(2, 2), **options)
    assert policy.follower.reads is options["reads"] and not policy.training
    assert policy.act(torch.zeros(3, policy.history, 4), torch.zeros(3, 14, 4), 0).shape == (3, 2)


def test_decoded_commands_become_changes_of_the_last_one():
    decoded = {"actions": [1], "commands": [2]}
    options = {"state_of": (0, 1), "decoded": decoded, "execution": Execution(blend=0.0, replan_interval=3)}
    policy = make_policy(CountingPlanner(), EchoController(), **options)
    observed = torch.tensor([[[3.0, 7.0, 0.0], [4.0, 8.0, 3.5]]])  # the last command stands in the third column
    plan = policy.planner.sample(observed[..., :2])
    assert policy.act(observed, plan, 0)[0].tolist() == [3.0, 4.0 - 3.5, 1004.0, 4.0]
    ahead, _ = policy.decode_ahead(observed, torch.zeros(1, 6, 2))
    assert ahead[0, :, 1].tolist() == [0.5, 1000.0, 1000.0]  # each is the change of the one before it
    law = make_policy(CountingPlanner(), ResponseModel([0, 1], [0, 1], [0, 1]), **options)
    assert law.decoded is None  # it knows the command, and gives changes
    sampled = make_policy(CountingSampler(), **options)
    chunk = sampled.plan(observed)
    assert sampled.act(observed, chunk, 2)[0, 1] == chunk[0, 2, 1] - 3.5


@pytest.mark.parametrize("options", [{"ranges": [None, (-600.0, 600.0), None, None]}, {"changes": [1], "gain": 1.5}])
def test_actions_decoded_ahead_continue_from_limited_commands_as_those_of_an_open_loop_do(options):
    gain, decoded = options.pop("gain", 1.0), {"actions": [1], "commands": [2]}
    execution = Execution("open_loop", blend=0.0, replan_interval=4, gain=gain)
    policy = make_policy(
        CountingPlanner(), EchoController(), state_of=(0, 1), decoded=decoded, execution=execution, **options
    )
    observed, noise = torch.tensor([[[3.0, 7.0, 0.0], [4.0, 8.0, -2000.0]]]), torch.zeros(1, 6, 2)
    ahead, _ = policy.decode_ahead(observed, noise)
    plan, seen = policy.plan(observed, noise), observed.clone()
    for step in range(4):
        action = policy.act(seen, plan, step)
        torch.testing.assert_close(ahead[:, step], action)
        seen[:, -1, 2] += action[:, 1]  # the observation repeats the command


@pytest.mark.parametrize("unread", [0.0, float("nan")])
@pytest.mark.parametrize("selected", [["action"], ["action", "plan"], ["plan"]])
def test_plans_are_made_when_due_whichever_entries_are_selected(selected, unread):
    policy, td = policy_of(), step_input(torch.zeros(1, 2, 3))
    policy.select_out_keys(*selected)
    for step in range(9):
        observed = torch.tensor([max(step - 1, 0), step]).float()[:, None].repeat(1, 1, 3)
        observed[..., 0] = unread  # a column that is not in the state
        td = policy(td.set("observation_history", observed).set("is_init", torch.full((1, 1), step == 0)))
    assert policy.planner.calls == [[0.0], [4.0], [8.0]]


def test_an_environment_that_is_left_out_of_a_step_goes_on_with_its_plan():
    policy, td, acted = policy_of(), step_input(torch.zeros(2, 2, 3)), []
    for step, under_way in enumerate([[True, True], [True, False], [True, True]]):
        td = policy(td.set("_step", torch.tensor(under_way)).set("is_init", torch.full((2, 1), step == 0)))
        acted.append(td["action"][:, 2].tolist())
    assert acted[0] == [1000.0, 1000.0] and acted[1][0] == 2000.0 and acted[2] == [3000.0, 2000.0]


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("mpc", [False, True])
def test_policies_are_pickled_selected_and_roll_out_in_their_own_precision(mpc, double):
    controller = ResponseModel([0, 1], [0, 1], [0, 1]) if mpc else make_koopman_inverse_dynamics(2, 2)
    policy = make_policy(small_planner(), controller, state_of=(2, 3), ranges=[(-0.01, 0.01)] * 2)
    dtype = torch.float64 if double else torch.float32
    policy = pickle.loads(pickle.dumps(policy)).to(dtype)
    env = PolicyEnv(AvoidingEnv(2, max_steps=5, dtype=dtype), policy)
    env.set_seed(0)
    whole = env.rollout(5, policy)["action"]
    assert whole.dtype == dtype
    env.set_seed(0)
    assert torch.equal(env.rollout(5, policy.select_out_keys("action"))["action"], whole)
