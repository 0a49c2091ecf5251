# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests planning in a thread while the previous plan is executed."""

import threading
import time
import warnings
from concurrent.futures import wait

import numpy as np
import pytest
import torch
from small_networks import small_planner
from toy_policies import CountingPlanner, EchoController

from torchrl_koap.modules import (
    Agent,
    AsynchronousAgent,
    Execution,
    ResponseModel,
    make_koopman_inverse_dynamics,
    make_policy,
)
from torchrl_koap.modules.execution.agent import FarStateWarning


class HeldPlanner(CountingPlanner):
    """Gives a plan only when it is let go, and keeps what it was told."""

    def __init__(self):
        super().__init__()
        self.let_go, self.known = threading.Event(), []
        self.let_go.set()

    def sample(self, history, noise=None, prefix=None):
        self.let_go.wait(10)
        self.known.append(prefix)
        return super().sample(history, noise)


def policy_of(**execution):
    execution = Execution(replan_interval=2, blend=0.0).replaced(**execution)
    commanded = {"commands": [0], "states": [1]}
    return make_policy(
        HeldPlanner(), EchoController(), state_of=(0, 1), execution=execution, changes=(0,), commanded=commanded
    )


def make_agent(**execution):
    return AsynchronousAgent(policy_of(**execution), control_hz=30.0)


def plan_behind(action):
    """State at which the plan was made, and how many steps ago, from the action's view of the next planned state."""
    ahead, made_at = action[2], action[3]
    return float(made_at), round(float(ahead - made_at) / 1000) - 1


def test_control_goes_on_with_the_old_plan_until_the_new_one_is_there():
    agent = make_agent()
    agent.reset()
    planner = agent.policy.planner
    seen = [plan_behind(agent.act(np.array([step, 0.0]))) for step in range(2)]
    assert seen == [(0, 0), (0, 1)]
    planner.let_go.clear()
    seen = [plan_behind(agent.act(np.array([step, 0.0]))) for step in range(2, 5)]  # due at 2, not ready
    assert seen == [(0, 2), (0, 3), (0, 4)]
    planner.let_go.set()
    agent._pending.result(10)
    assert plan_behind(agent.act(np.array([5.0, 0.0]))) == (2, 3)  # begun at state 2, three steps ago
    agent.close()


def test_a_new_plan_begins_with_the_actions_executed_during_planning():
    agent = make_agent()
    agent.reset()
    for step in range(3):
        agent.act(np.array([step, 0.0]))
    agent._pending.result(10)
    first, second = agent.policy.planner.known
    assert first is None
    # one step is what a plan of a few microseconds takes; it was due after two steps of the plan made at state 0
    torch.testing.assert_close(second, torch.tensor([[[3000.0, 0.0]]]))
    agent.close()


def test_a_slow_plan_is_bound_for_whole_steps_but_never_completely():
    agent = make_agent()
    assert [agent._steps(seconds) for seconds in (0.0, 0.02, 0.05)] == [1, 1, 2]  # of 33 ms
    agent.reset(np.zeros(2))
    agent._delay = 50
    for step in range(3):
        agent.act(np.array([step, 0.0]))
    agent._pending.result(10)
    assert agent.policy.planner.known[1].shape == (1, 5, 2)  # of six states
    agent.close()


@pytest.mark.parametrize("slow", [0, 1])
def test_the_time_of_the_last_plan_says_how_much_of_the_next_one_is_bound(slow, monkeypatch):
    agent, sample = make_agent(), HeldPlanner.sample
    known = agent.policy.planner.known

    def slowly(planner, *given, **options):
        time.sleep(0.05 * (len(known) == slow))  # 1.5 control steps
        return sample(planner, *given, **options)

    monkeypatch.setattr(HeldPlanner, "sample", slowly)
    agent.reset(np.zeros(2))
    for step in range(5):
        agent.act(np.array([step, 0.0]))
        if agent._pending is not None:
            agent._pending.result(10)
    assert len(known) == 3 and known[slow + 1].shape[1] >= 2
    agent.close()


def test_a_reset_waits_for_the_plan_of_the_last_episode():
    agent = make_agent()
    planner = agent.policy.planner
    agent.reset(np.zeros(2))
    planner.let_go.clear()
    for _ in range(3):
        agent.act(np.zeros(2))
    threading.Timer(0.05, planner.let_go.set).start()
    agent.reset()
    assert len(planner.known) == 2
    agent.close()


def test_a_plan_that_ends_before_the_next_is_there_is_told_in_every_episode():
    agent = make_agent()
    planner, steps = agent.policy.planner, agent.policy.planner.horizon
    for _ in range(2):
        agent.reset(np.zeros(2))
        planner.let_go.clear()
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("default")
            ages = [plan_behind(agent.act(np.zeros(2)))[1] for _ in range(steps)]
            assert not told
            agent.act(np.zeros(2))
            assert told
            agent.act(np.zeros(2))
        planner.let_go.set()
        assert [each.filename for each in told] == [__file__]
        assert f"planning may take at most {1e3 * (steps - 2) / 30:.0f} ms" in str(told[0].message)
        assert ages == list(range(steps))
    agent.close()


def test_reset_makes_the_first_plan():
    agent = make_agent()
    agent.reset(np.array([7.0, 0.0]))
    assert agent.policy.planner.calls == [[7.0]]
    assert plan_behind(agent.act(np.array([7.0, 0.0]))) == (7, 0)
    assert agent.policy.planner.calls == [[7.0]]
    agent.close()


def test_commands_are_limited_as_in_the_policy():
    agent = make_agent(lead=0.1)
    agent.reset()
    for step in range(4):
        action = agent.act(np.array([step / 20, 0.0]))  # a command ahead of a robot that stands still
        assert abs(step / 20 + action[0]) <= 0.1 + 1e-6
    agent.close()


def test_another_rate_than_that_of_the_data_is_warned_of(recwarn):
    networks = make_agent().policy
    policy = make_policy(networks.planner, networks.follower.controller, state_of=(0, 1), control_hz=20.0)
    with pytest.warns(UserWarning, match="control_hz is 26, the policy was trained on data of 20 Hz"):
        AsynchronousAgent(policy, control_hz=26).close()
    recwarn.clear()
    AsynchronousAgent(policy, control_hz=24).close()
    assert not recwarn.list


def test_warnings_of_a_far_state_name_the_line_of_the_caller():
    policy = make_policy(small_planner(), make_koopman_inverse_dynamics(2, 2), state_of=(0, 1))
    with AsynchronousAgent(policy, control_hz=30.0) as agent, pytest.warns(FarStateWarning) as told:
        agent.reset(np.array([99.0, 0.0]))
        agent.act(np.array([99.0, 99.0]))
    assert [each.filename for each in told] == [__file__] * 2


def test_refusals():
    for wrong in (0, "20", None, float("nan"), True):
        with pytest.raises(ValueError, match=f"control_hz must be a positive number .*, got {wrong!r}"):
            AsynchronousAgent(policy_of(), control_hz=wrong)
    with pytest.raises(ValueError, match="needs strategy 'feedback', got 'open_loop'"):
        AsynchronousAgent(policy_of(strategy="open_loop"), control_hz=30)


def test_a_closed_agent_raises_errors_at_once():
    agent = make_agent()
    agent.reset()
    agent.act(np.zeros(2))
    agent.close()
    for call in (lambda: agent.act(np.zeros(2)), agent.reset, lambda: agent.reset(np.zeros(2))):
        with pytest.raises(RuntimeError, match="the agent was closed: make a new one"):
            call()
    agent.close()


@pytest.mark.parametrize("wrong", ["runs/arm", object()])
def test_other_objects_than_policies_raise_the_error_of_the_agent(wrong):
    with pytest.raises(TypeError, match=r"policy must come from load_policy\(\) or Trained.policy\(\), got"):
        AsynchronousAgent(wrong, control_hz=30)


def test_plans_are_followed_as_the_policy_follows_them():
    planner, law = small_planner(), ResponseModel([0, 1], [0, 1], [0, 1])
    law.weight[[0, 1], [0, 1], 2] = 0.3
    policy, plain = (make_policy(planner, by, state_of=(2, 3)) for by in (law, make_koopman_inverse_dynamics(2, 2)))
    observations = np.random.default_rng(0).normal(size=(3, 4))
    acted = []
    for agent in (Agent(policy), AsynchronousAgent(policy, control_hz=1.0), Agent(plain)):
        agent.reset()
        acted.append(np.stack([agent.act(row) for row in observations]))
    np.testing.assert_allclose(acted[0], acted[1], atol=1e-6)
    assert not np.allclose(acted[0], acted[2], atol=1e-6)


def test_an_error_of_the_thread_ends_its_episode_alone(monkeypatch):
    agent, answer = make_agent(), np.zeros(2)
    agent.reset()
    before = agent.act(answer)
    agent.act(answer)

    def fails(*inputs, **options):
        raise RuntimeError("no plan")

    with monkeypatch.context() as broken:
        broken.setattr(agent.policy.planner, "sample", fails)
        agent.act(answer)  # due
        wait([agent._pending])
        with pytest.raises(RuntimeError, match="no plan"):
            agent.act(answer)
        agent.act(answer)  # due again
    agent.reset()
    np.testing.assert_array_equal(agent.act(answer), before)
    agent.close()
