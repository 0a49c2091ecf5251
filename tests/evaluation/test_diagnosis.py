# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the figures of `koap inspect` for planner alone, controller alone, and both."""

import json
import math
from dataclasses import replace

import pytest
import torch
from command_calls import fails
from pretended_gpu import pretended_gpu
from tensordict import TensorDict
from tiny_runs import koap
from toy_policies import EchoController

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.envs.contexts import evaluation_contexts
from torchrl_koap.envs.registry import make_env
from torchrl_koap.evaluation import diagnosis, inspection
from torchrl_koap.evaluation.diagnosis import (
    RECORDED_FUTURE,
    contexts_of,
    distance_to_demonstrations,
    follow_recordings,
    left_recordings,
    planner_rollout,
    recorded_futures,
    tracking_errors,
)
from torchrl_koap.modules import Execution, ExecutionConfig, MLPDenoiser, StatePlanner, make_policy
from torchrl_koap.reports.inspection_plots import draw_experiments
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.tasks import Action, Task, get_task
from torchrl_koap.training import Trained

AVOIDING = get_task("avoiding")


class Straight(torch.nn.Module):
    """Plans that go on by the last step."""

    history, horizon, state_dim, noise_shape = 2, 14, 2, (14, 2)

    def sample(self, history, noise=None):
        step = history[:, -1] - history[:, -2] + torch.tensor([0.0, 0.01])
        ahead = torch.arange(1, 15)[:, None]
        return history[:, -1:] + ahead * step[:, None]


def test_a_planner_alone_goes_on_from_its_own_plans():
    path = planner_rollout(Straight(), torch.tensor([[0.5, -0.3], [0.4, 0.0]]), interval=4, max_steps=13)
    assert path.shape == (2, 13, 2) and torch.equal(path[:, 0], torch.tensor([[0.5, -0.3], [0.4, 0.0]]))
    # the first plan starts at rest: 0.01 per step; every later one goes on at the speed reached plus 0.01
    steps = path[0, :, 1].diff()
    torch.testing.assert_close(steps, torch.tensor([0.01] * 4 + [0.02] * 4 + [0.03] * 4))
    assert not AVOIDING.goal_reached(path).any()
    assert AVOIDING.goal_reached(planner_rollout(Straight(), path[:, 0], interval=4, max_steps=41)).any(-1).all()


@pytest.mark.parametrize("name", ["aligning", "sorting", "stacking"])
def test_contexts_are_found_again_in_the_first_observation(name):
    task, contexts = get_task(name), evaluation_contexts(name)[:3]
    env = make_env(name, 3, dtype=torch.float64)
    observed = env.reset(contexts=contexts)["observation"]
    found = contexts_of(task, observed).numpy()
    assert abs(found[..., :2] - contexts[..., :2]).max() < 1e-3  # the reset lasts 1 ms
    turn = found[..., 2] - contexts[..., 2]
    assert abs(math.pi * (turn / math.pi).round() - turn).max() < 1e-2  # a box looks the same after half a turn
    assert env.reset(contexts=found)["observation"].shape == (3, task.observation_dim)
    for part in (task.observation[body.yaw] for body in task.bodies):
        observed[:, part] *= -1 if part.stop - part.start == 4 else 1  # the sign of a quaternion says nothing
    torch.testing.assert_close(contexts_of(task, observed), torch.from_numpy(found))


def test_futures_of_recordings_by_hand():
    futures = recorded_futures([torch.arange(4.0)[:, None], torch.arange(2.0)[:, None]], horizon=3)
    assert futures[..., 0].tolist() == [
        [[1, 2, 3], [2, 3, 3], [3, 3, 3], [3, 3, 3]],
        [[1, 1, 1], [1, 1, 1], [1, 1, 1], [1, 1, 1]],
    ]


def episode(offset, steps=8):
    """Moves by 1 per step along x; plans say the same, ``offset`` beside it."""
    frames = torch.zeros(steps + 1, 4)
    frames[:, 2] = torch.arange(steps + 1.0)
    ahead = frames[:steps, None, 2:] + torch.arange(1, 15)[:, None] * torch.tensor([1.0, 0.0])
    flags = torch.zeros(steps, 1, dtype=torch.bool)
    flags[-1] = True
    plan = ahead + torch.tensor([0.0, offset])
    nested = {"observation": frames[1:], "success": flags}
    return TensorDict({"observation": frames[:-1], "plan": plan, "next": nested}, [steps])


def test_distance_from_plan_to_execution_by_hand():
    errors = tracking_errors(AVOIDING, [episode(0.3), episode(0.4)], 4)
    assert list(errors) == ["measured_xy (m)"]
    assert errors["measured_xy (m)"] == pytest.approx([math.sqrt((0.09 + 0.16) / 2)] * 4)
    assert tracking_errors(AVOIDING, [episode(0.3).exclude("plan")], 4) == {}
    stands = episode(0.3, steps=16)
    stands["plan"][8:] += 9.0
    stands["recorded"] = torch.arange(16)[:, None] < 8  # what comes after the recording's end is not held against it
    assert tracking_errors(AVOIDING, [stands], 4)["measured_xy (m)"] == pytest.approx([0.3] * 4)
    brief = episode(9.0, steps=2)  # shorter than the interval between plans: there is nothing to judge
    assert tracking_errors(AVOIDING, [brief, stands], 4)["measured_xy (m)"] == pytest.approx([0.3] * 4)
    episodes = [brief, stands, episode(0.4), episode(0.5)]
    assert [left_recordings(AVOIDING, episodes, 4, beyond=limit) for limit in (0.2, 0.35, 0.6)] == [3, 2, 0]


def test_units_of_a_part_are_not_pooled():
    parts, units = {"tool": ("x", "y", "turn"), "q": 1}, ("m", "m", "rad", "rad")
    actions = {"dx": Action("m")}
    arm = Task(name="arm", actions=actions, observation_parts=parts, observation_units=units, position="tool")
    steps = torch.zeros(8, 4)
    plan = torch.tensor([0.3, 0.4, 2.0, 1.0]).expand(8, 14, 4)
    follows = TensorDict({"observation": steps, "next": {"observation": steps}, "plan": plan}, [8])
    errors = tracking_errors(arm, [follows], 4)
    wanted = {"tool (m)": 0.5, "tool (rad)": 2.0, "q (rad)": 1.0}
    assert errors == {name: pytest.approx([value] * 4) for name, value in wanted.items()}
    assert [left_recordings(arm, [follows], 4, beyond=limit) for limit in (0.4, 0.6)] == [1, 0]


def test_states_beside_the_demonstrations_are_far():
    shown = torch.rand(400, 2, generator=torch.Generator().manual_seed(0))
    data = TensorDict({"state": shown, "episode": torch.arange(400) // 10}, [400])
    near, far = episode(0), episode(0)
    near["observation"][:, 2:] = shown[:8] + 0.001
    far["observation"][:, 2:] = shown[:8] + 5
    distances = distance_to_demonstrations(AVOIDING, [near], data)
    assert distances["visited_95"] < 1.5 * distances["demonstrated_95"]
    assert distance_to_demonstrations(AVOIDING, [far], data)["visited_95"] > 5
    there, moved = data.clone(), near.clone()
    there["state"] += 256  # m; float32 squares of such numbers hide the distances
    moved["observation"] += 256
    assert distance_to_demonstrations(AVOIDING, [moved], there) == pytest.approx(distances, rel=0.05)


@pytest.mark.parametrize("command", ["eval --no-report", "eval --no-report --strategy oracle", "inspect"])
def test_on_a_gpu_all_is_as_on_the_processor(command, copied_run, tmp_path, monkeypatch):
    name, *options = command.split()
    call = (name, copied_run, *options, "--episodes", 2, "--threads", 1)
    file = {"eval": "rollouts.safetensors", "inspect": "inspect.json"}[name]
    assert koap(*call, "--out", tmp_path / "cpu") == 0
    with pretended_gpu(monkeypatch):
        assert koap(*call, "--out", tmp_path / "gpu", "--device", "cuda:0") == 0
    assert (tmp_path / "gpu" / file).read_bytes() == (tmp_path / "cpu" / file).read_bytes()


def test_inspect_from_the_shell(copied_run, capsys):
    run = copied_run
    assert koap("inspect", run, "--episodes", "2", "--threads", "1") == 0
    written = json.loads((run / "inspect.json").read_text())
    assert {"planner_alone", "controller_alone", "both", "plan_to_execution", "findings"} <= set(written)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1].split(maxsplit=2)[2] == str(run / "inspect.json") and max(map(len, lines[:-2])) < 200
    assert written["both"]["episodes"] == 2 and (run / "plots" / "inspect.png").exists()
    assert "episodes must be >= 1, got 0" in fails(capsys, "inspect", run, "--episodes", "0")
    assert koap("inspect", run, "--strategy", "open_loop", "--episodes", "2", "--threads", "1") == 0
    assert all(len(line.split()) > 1 for line in capsys.readouterr().out.splitlines())  # no distances without plans


def test_plans_are_followed_as_the_task_says_and_no_planner_is_rated_without_a_goal(copied_run, monkeypatch, tmp_path):
    trained = Trained.load(copied_run)
    own = {"strategy": "open_loop", "replan_interval": 8, "blend": 0.0, "gain": 1.2, "lead": 0.05}
    task = replace(trained.task, goal=None)
    config = replace(trained.config, execution=ExecutionConfig(**own))
    other = replace(trained, task=task, config=config)
    policies, roll_out = [], diagnosis.roll_out

    def noted(policy, *arguments, **options):
        policies.append(policy)
        return roll_out(policy, *arguments, **options)

    monkeypatch.setattr(Trained, "load", lambda run, plugins: other)
    for module in (inspection, diagnosis):
        monkeypatch.setattr(module, "roll_out", noted)
    asked = inspection.InspectConfig(episodes=2, threads=1)
    result = inspection.inspect(copied_run, asked)
    for policy in policies:  # recordings are followed by the same actions as plans
        assert policy.execution == Execution(**own)
        assert policy.limits.gain == 1.2 and policy.limits.lead == 0.05
    assert len(policies) == 2 and policies[1].follower is policies[0].follower
    assert "planner_alone" not in result and result["both"]["episodes"] == 2
    assert result["plan_to_execution"] == {}  # actions are kept, not plans
    assert len(draw_experiments(result, RunFacts(tmp_path, task)).axes) == 2
    inspection.inspect(copied_run, replace(asked, execution=ExecutionConfig(replan_interval=4)))
    assert policies[-1].execution == Execution(**own | {"replan_interval": 4})
    config = replace(trained.config, execution=ExecutionConfig(temperature=0.5, candidates=3))
    cold = replace(trained, config=config)
    monkeypatch.setattr(Trained, "load", lambda run, plugins: cold)
    inspection.inspect(copied_run, asked)
    used = [(policy.execution.temperature, policy.execution.candidates) for policy in policies[-2:]]
    assert used == [(0.5, 3), (1, 1)]  # recordings are no noise


@pytest.mark.parametrize("away", [0.0, 2.0])
def test_recordings_of_another_embodiment_are_not_followed_nor_those_that_start_elsewhere(away, monkeypatch):
    states = [torch.full((20, 4), float(number)) for number in range(6)]
    actions = [torch.full((19, 2), float("nan") if number < 4 else 0.1) for number in range(6)]
    data = flatten_trajectories(states, actions)
    data["state"] = data["observation"][:, :2].clone()
    plans = []

    def noted(policy, make_env, seeds, *, given, **_):
        plans.extend(given(slice(index, index + 1))(TensorDict())[RECORDED_FUTURE] for index in seeds)
        played = [episode(0.0, steps=24) for _ in seeds]
        for plan, rollout in zip(plans, played, strict=True):
            rollout["observation"][:, 2:] += plan[0, 0] + away  # columns of numbers from 0 to 5
        return played

    monkeypatch.setattr(diagnosis, "roll_out", noted)
    planner = StatePlanner(MLPDenoiser(2, 4, horizon=14, width=8), state_dim=2)
    policy = make_policy(planner, EchoController(), state_of=(0, 1))
    followed = follow_recordings(policy, AVOIDING, data, None, episodes=5)
    assert [future[0, 0, 0].item() for future in plans] == [4.0, 5.0]
    # frames of a path but its first
    assert [part["recorded"].sum().item() for part in followed] == ([] if away else [18, 18])
