# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the oracle controller: the tool follows the plan in any batch, and only in a simulation."""

import json
from dataclasses import replace

import pytest
import torch
from command_calls import fails
from tiny_runs import TINY, koap

from torchrl_koap.envs import AvoidingEnv
from torchrl_koap.evaluation.diagnosis import RecordedPlanner, hand_on
from torchrl_koap.evaluation.oracle import OracleFollower
from torchrl_koap.evaluation.rollouts import roll_out
from torchrl_koap.modules import Execution, MLPDenoiser, StatePlanner, make_policy
from torchrl_koap.tasks import get_task

TASK = get_task("avoiding")
STEPS = 30
HORIZON = 14


def small_planner():
    return StatePlanner(MLPDenoiser(2, 4, horizon=HORIZON, width=8), state_dim=2)


def policy_of(planner):
    follower = OracleFollower(TASK, blend=0.0)
    return make_policy(planner, state_of=TASK.state_of, follower=follower, execution=Execution(replan_interval=1))


def test_the_tool_goes_where_the_plan_says():
    start = AvoidingEnv(1).reset()["observation"][0, 2:]
    ramp = torch.cat([torch.linspace(0, 1, 6), torch.ones(STEPS + HORIZON)]).cumsum(0)
    path = start + ramp[:, None] * torch.tensor((0.002, 0.006))  # a line, with this way per control step
    futures = torch.stack([path[step + 1 : step + 1 + HORIZON] for step in range(STEPS)])
    policy = policy_of(RecordedPlanner(small_planner()))
    (episode,) = roll_out(policy, AvoidingEnv, [0], max_steps=STEPS, given=lambda part: hand_on(futures[None][part]))
    seen = episode["next", "observation"][:, 2:]
    planned = futures[:, 0]  # the next state, of every step
    error = (seen - planned).norm(dim=-1)
    assert error[8:].max() < 1e-3  # it covers 19 cm
    assert (planned[-1] - planned[0]).norm() > 0.15


def test_episodes_that_are_over_leave_the_others_alone():
    start = AvoidingEnv(1).reset()["observation"][0, 2:]
    ahead = torch.arange(1, STEPS + HORIZON)[:, None]
    paths = [start + ahead * torch.tensor(step) for step in ((0.0, 0.02), (0.0005, 0.001))]  # the first one collides
    futures = torch.stack([path.unfold(0, HORIZON, 1).mT for path in paths])

    def followed(rows):
        given = lambda part: hand_on(futures[rows][part])  # noqa: E731
        return roll_out(policy_of(RecordedPlanner(small_planner())), AvoidingEnv, rows, max_steps=STEPS, given=given)

    first, second = followed([0, 1])
    assert len(first) < STEPS == len(second)
    torch.testing.assert_close(second["action"], followed([1])[0]["action"])


@torch.no_grad()
def test_wrong_uses():
    observed, plan = torch.zeros(1, 2, 4), torch.zeros(1, HORIZON, 2)
    with pytest.raises(RuntimeError, match=r"call policy.attach\(env\)"):
        policy_of(small_planner()).act(observed, plan, 0)
    attached = policy_of(small_planner())
    attached.attach(AvoidingEnv(1))
    with pytest.raises(RuntimeError, match="decodes one action"):
        attached.follower(observed, observed[..., 2:], plan, 2)
    with pytest.raises(ValueError, match="task 'avoiding' has no environment"):
        OracleFollower(replace(TASK, env=None), blend=0.0)


def test_the_command(copied_run, tmp_path):
    options = ("--episodes", 1, "--threads", 1, "--no-report", "--strategy", "oracle", "--out", tmp_path / "out")
    assert koap("eval", copied_run, *options) == 0
    result = json.loads((tmp_path / "out" / "eval.json").read_text())
    execution = result["execution"]
    assert execution["strategy"] == "oracle" and execution["blend"] == 0.8 and result["plan_ms"] > 0


def test_methods_without_plans_and_other_environments_raise_errors(demonstrations, copied_run, tmp_path, capsys):
    dp = ("--out", tmp_path / "dp", "--dataset", demonstrations, "--method", "dp", *TINY)
    assert koap("train", *dp) == 0
    for run, option, message in (
        (tmp_path / "dp", (), "strategy 'oracle' was asked of method 'dp', which samples actions"),
        (copied_run, ("--env", "CartPole-v1"), "reads the task's own simulation; it cannot be combined with env"),
    ):
        assert message in fails(capsys, "eval", run, "--strategy", "oracle", *option)
        assert not (run / "eval.json").exists()
