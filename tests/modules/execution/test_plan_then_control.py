# This source code is licensed under the MIT license found in the LICENSE file.
"""Which frame of which plan is used at which step, against a reference loop, in collectors with auto-reset."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType
from toy_policies import (
    CountingPlanner,
    EchoController,
    EpisodesOfRandomLength,
    PlannedStep,
    state_number,
    wandering_planner,
)

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.modules import (
    EpisodeNoise,
    PlanThenControl,
    StatePlanner,
    TemporalUnet,
    blend_plan,
    make_koopman_inverse_dynamics,
    policy_transforms,
)

LENGTHS = ((5, 3, 11), (9,), (1, 2, 7, 4), (12, 6), (4, 4, 8))


def make_policy(execution="feedback", interval=4, history=2, **options):
    options.setdefault("blend_decay", 0.0)  # the reference loop decodes plans as they are
    return PlanThenControl(
        CountingPlanner(),
        EchoController(),
        state_columns=(1, 2),
        history=history,
        execution=execution,
        replan_interval=interval,
        **options,
    )


def expected_action(env, episode, step, interval, execution):
    """Written from the picture in the class's docstring, one step at a time."""

    def x(at):
        return state_number(env, episode % 5, at)

    planned_at = step - step % interval
    age = step - planned_at
    following = [x(planned_at) + 1000 * (age + 1), x(planned_at)]  # frame `age` of the plan, and where it was made
    if execution == "feedback":
        return [x(max(step - 1, 0)), x(step), *following]
    if age == 0:
        return [x(max(planned_at - 1, 0)), x(planned_at), *following]
    before = x(planned_at) + 1000 * (age - 1) if age > 1 else x(planned_at)
    return [before, x(planned_at) + 1000 * age, *following]


@pytest.mark.parametrize("execution", ["feedback", "open_loop"])
@pytest.mark.parametrize("interval", [1, 3, 4, 6])
@pytest.mark.parametrize("num_envs", [1, 5])
def test_every_action_in_a_collector_with_auto_reset(execution, interval, num_envs):
    env = TransformedEnv(EpisodesOfRandomLength(num_envs, LENGTHS), policy_transforms(2))
    policy = make_policy(execution, interval)
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
            assert data["observation"][index, row, 1] == state_number(index, episode % 5, step)
            expected = expected_action(index, episode, step, interval, execution)
            assert data["action"][index, row].tolist() == expected, (index, episode, step)
            before = state_number(index, episode % 5, max(step - 1, 0))
            assert data["observation_history"][index, row, :, 1].tolist() == [before, expected_at(index, episode, step)]
            plans += step % interval == 0
            step += 1
            if data["next", "done"][index, row]:
                episode, step = episode + 1, 0
        made = sum(int(number // 100) == index for call in policy.planner.calls for number in call)
        assert made == plans  # the planner runs for rows that need a plan, and for no others


def expected_at(env, episode, step):
    return state_number(env, episode % 5, step)


@pytest.mark.parametrize("execution", ["feedback", "open_loop"])
def test_collectors_of_any_exploration_and_a_plain_rollout_agree(execution):
    env = TransformedEnv(EpisodesOfRandomLength(3, LENGTHS), policy_transforms(2))
    rollout = env.rollout(12, make_policy(execution), break_when_any_done=False)
    for row in range(12):
        if not rollout["is_init"][1, : row + 1].sum() == 1:
            break
        assert rollout["action"][1, row].tolist() == expected_action(1, 0, row, 4, execution)
    assert row == 9


def test_the_last_planned_state_is_repeated_when_the_plan_runs_out():
    policy = make_policy("feedback", interval=6)
    td = TensorDict({"observation_history": torch.zeros(1, 2, 3), "is_init": torch.ones(1, 1, dtype=torch.bool)}, [1])
    lefts = []
    for _ in range(6):
        td = policy(td)
        lefts.append(td["remaining_plan"][0, :, 0].tolist())
        td["is_init"] = torch.zeros(1, 1, dtype=torch.bool)
    for age, left in enumerate(lefts):
        assert left == [1000.0 * min(frame + age, 6) for frame in range(1, 7)]


@pytest.mark.parametrize("execution", ["feedback", "open_loop"])
def test_longer_histories_reach_the_controller_shorter_ones_the_planner(execution):
    policy = make_policy(execution, history=5)
    observed = torch.arange(15.0).reshape(1, 5, 3)
    td = policy(TensorDict({"observation_history": observed, "is_init": torch.ones(1, 1, dtype=torch.bool)}, [1]))
    assert policy.planner.calls == [[13.0]]
    assert td["action"].tolist() == [[10.0, 13.0, 1013.0, 13.0]]


@pytest.mark.parametrize("execution", ["feedback", "open_loop"])
def test_renamed_keys_of_policy_and_controller(execution):
    policy = PlanThenControl(
        CountingPlanner(),
        EchoController(in_key=("in", "x"), out_key=("out", "u")),
        state_columns=(1, 2),
        history=2,
        execution=execution,
        history_key=("agent", "frames"),
        action_key=("agent", "command"),
        blend_decay=0.0,
    )
    expected = make_policy(execution)
    observed = torch.rand(3, 2, 3)
    renamed = TensorDict({"agent": {"frames": observed}, "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
    plain = TensorDict({"observation_history": observed, "is_init": torch.ones(3, 1, dtype=torch.bool)}, [3])
    for _ in range(6):
        renamed, plain = policy(renamed), expected(plain)
        assert torch.equal(renamed["agent", "command"], plain["action"])
        assert set(policy.out_keys) <= set(renamed.keys(True))
        for td in (renamed, plain):
            td["is_init"] = torch.zeros(3, 1, dtype=torch.bool)
    assert list(policy.in_keys) == [("agent", "frames"), "is_init"]


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="unknown execution 'open-loop'; did you mean 'open_loop'"):
        make_policy("open-loop")
    with pytest.raises(ValueError, match="planner reads 2 observed frames, history is only 1"):
        make_policy(history=1)
    with pytest.raises(ValueError, match="controller reads 4 observed frames, history is only 3"):
        PlanThenControl(CountingPlanner(), EchoController(num_past=3), state_columns=(0, 1), history=3)
    for interval in (0, 7):
        with pytest.raises(ValueError, match=rf"replan_interval must be in 1..6 \(the horizon\), got {interval}"):
            make_policy(interval=interval)


def test_a_missing_transform_is_named():
    env = EpisodesOfRandomLength(2, LENGTHS)
    with pytest.raises(KeyError, match="reads 'observation_history': append policy_transforms"):
        env.rollout(2, make_policy())
    with pytest.raises(KeyError, match="reads 'is_init': append policy_transforms"):
        make_policy()(TensorDict({"observation_history": torch.zeros(2, 2, 3)}, [2]))
    with pytest.raises(ValueError, match=r"must hold 2 frames on axis -2, got \[2, 4, 3\]"):
        td = {"observation_history": torch.zeros(2, 4, 3), "is_init": torch.ones(2, 1, dtype=torch.bool)}
        make_policy()(TensorDict(td, [2]))


def test_noise_of_an_episode_depends_on_its_seed_and_step_alone():
    together = EpisodeNoise([3, 9, 4], (5, 2), num_steps=4)
    alone = EpisodeNoise([9], (5, 2), num_steps=4)
    draws = []
    for _ in range(4):
        td = together(TensorDict(batch_size=[3]))
        assert torch.equal(td["noise"][1:2], alone(TensorDict(batch_size=[1]))["noise"])
        draws.append(td["noise"])
    assert torch.stack(draws).flatten().unique().numel() == 4 * 3 * 10
    with pytest.raises(RuntimeError, match="noise was drawn for 4 steps only"):
        together(TensorDict(batch_size=[3]))
    state = torch.get_rng_state()
    EpisodeNoise([1], (5, 2), num_steps=4)
    assert torch.equal(torch.get_rng_state(), state)  # the global generator is left alone


@pytest.mark.parametrize("execution", ["feedback", "open_loop"])
def test_a_real_policy_collects_from_sixty_avoiding_environments(execution):
    """Plans are made at steps 0, 4, ... only, and all environments, equal at the start, go their own ways."""
    torch.manual_seed(0)
    env = TransformedEnv(AvoidingEnv(60), policy_transforms(5))
    planner = StatePlanner(TemporalUnet(2, 4, channels=(8, 16)), state_dim=2, num_steps=2)
    planner.fit_normalizers(0.01 * torch.randn(50, 16, 2).cumsum(1))
    policy = PlanThenControl(
        planner, make_koopman_inverse_dynamics(2, 2), state_columns=(2, 3), history=5, execution=execution
    )
    calls = []
    plan = planner.sample
    planner.sample = lambda *arguments: calls.append(len(arguments[0])) or plan(*arguments)
    collector = Collector(
        env, policy, frames_per_batch=60 * 6, total_frames=60 * 6, exploration_type=ExplorationType.DETERMINISTIC
    )
    calls.clear()  # the collector tries the policy once
    (data,) = collector
    assert data.shape == (60, 6) and data["action"].isfinite().all()
    assert calls == [60, 60]
    assert torch.equal(data["observation_history"][:, 0], data["observation"][:, :1].expand(60, 5, 4))
    assert torch.equal(data["observation_history"][:, 5, 1:], data["observation"][:, 2:])
    key = "remaining_plan_chunk" if execution == "feedback" else "action_chunk"
    chunks = data[key]
    assert all(torch.equal(chunks[:, step], chunks[:, 0]) for step in range(4))
    assert not torch.equal(chunks[:, 4], chunks[:, 0])
    assert data["action"][:, 0].unique(dim=0).shape[0] == 60
    collector.shutdown()


def test_a_stochastic_start_stays_stochastic_under_deterministic_exploration():
    """Two equal observations get two plans: with one fixed start noise all episodes would take the same way."""
    policy = PlanThenControl(wandering_planner(), PlannedStep(), state_columns=(0, 1), history=2)
    td = TensorDict({"observation_history": torch.zeros(2, 2, 2), "is_init": torch.ones(2, 1, dtype=torch.bool)}, [2])
    action = policy(td)["action"]
    assert not torch.equal(action[0], action[1])


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
    uneven = torch.tensor([[1.0], [5.0], [3.0]])  # least-squares line through (1, 1), (2, 5), (3, 3): at 0 it is 1
    torch.testing.assert_close(blend_plan(torch.tensor([[1.0]]), uneven, 0.5), uneven)
