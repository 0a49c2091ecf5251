# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the evaluation of a user's own robot in a Gymnasium environment."""

import json
import sys
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from offline_runs import record
from safetensors.numpy import load_file
from tiny_runs import koap
from toy_gym import NAMES

from torchrl_koap import ControllerConfig, EvalConfig, PlannerConfig, TrainConfig, evaluate, save_demonstrations, train
from torchrl_koap.evaluation import InspectConfig, closed_loop, inspect
from torchrl_koap.evaluation.config import environment_arguments
from torchrl_koap.evaluation.statistics import rate
from torchrl_koap.reports.advice import advice
from torchrl_koap.reports.inspection_plots import draw_experiments
from torchrl_koap.reports.rows import as_text, evaluation_rows
from torchrl_koap.reports.run_facts import RunFacts
from torchrl_koap.runs.run_directory import RunDirectoryError


@pytest.fixture(scope="module")
def arm_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    states, actions = record(5, 31, joints=2)
    actions = [steps if index < 2 else None for index, steps in enumerate(actions)]
    data = save_demonstrations(folder / "data", states, actions, control_hz=30, state_names=NAMES, robot=NAMES[:2])
    run = folder / "run"
    few = {"planner": PlannerConfig(steps=10, batch_size=8, width=8), "controller": ControllerConfig(steps=0)}
    train(TrainConfig(dataset=str(data), out=run, **few))
    return run


def test_the_command(arm_run):
    asked = ("--env", "toy_gym:ToyReachOwnKey-v0", "--success-key", "arrived", "--no-animate")
    assert koap("eval", arm_run, "--episodes", 3, "--threads", 1, *asked) == 0
    result = json.loads((arm_run / "eval.json").read_text())
    assert result["episodes"] == 3 and result["rates"]["success"] == rate([True] * 3)
    assert not {"mode_entropy", "collisions"} & set(result) and result["env"] == "toy_gym:ToyReachOwnKey-v0"
    assert [row["seed"] for row in result["episode"]] == [100, 101, 102]
    assert {row["steps"] for row in result["episode"]} == {6}
    page = (arm_run / "index.html").read_text()
    assert "3 of 3 rollouts" in page and "--env toy_gym:ToyReachOwnKey-v0" in page


def test_a_module_beside_the_data_is_found(arm_run, tmp_path, monkeypatch):
    code = "import gymnasium, toy_gym\ngymnasium.register('Beside-v0', toy_gym.Reach, kwargs={'key': 'is_success'})\n"
    (tmp_path / "beside_the_data.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path not in ("", str(tmp_path))])
    config = EvalConfig(episodes=2, env="beside_the_data:Beside-v0", threads=1, out=tmp_path / "out")
    assert evaluate(arm_run, config)["rates"]["success"]["rate"] == 1.0


def test_step_limit_success_and_arguments_are_said(arm_run, capsys):
    asked = ("--env", "toy_gym:ToyReach-v0", "--env-kwargs", "max_episode_steps=4", "length=9", "--no-animate")
    assert koap("eval", arm_run, "--episodes", 2, "--threads", 1, *asked) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "at most 4 steps (--env-kwargs); success: info['is_success']" in printed
    result = json.loads((arm_run / "eval.json").read_text())
    assert {row["steps"] for row in result["episode"]} == {4}
    assert "--env-kwargs max_episode_steps=4 length=9" in (arm_run / "index.html").read_text()
    with pytest.warns(UserWarning, match="has no step limit: an episode that it does not end lasts 46 steps"):
        assert koap("eval", arm_run, "--episodes", 1, "--env", "toy_gym:ToyReachLost-v0", "--no-report") == 0
    printed = " ".join(capsys.readouterr().out.split())
    found = json.loads((arm_run / "eval.json").read_text())
    assert found["step_limit"] == "46 steps (that of task 'data': the environment has none)"
    ends = "else an end with more than twice any earlier reward"
    assert found["success"] == f"success: info['is_success'] or info['success'] if there is one, {ends}"
    assert "mean return 0" in printed and "no episode reported success in info or ended with more than" in printed
    assert koap("eval", arm_run, "--episodes", 1, "--env", "toy_gym:ToyLimited-v0", "--no-report") == 0
    assert "at most 5 steps (the environment's own); success" in " ".join(capsys.readouterr().out.split())


def test_rollouts_that_do_not_leave_their_start_are_told(arm_run, monkeypatch):
    made = type(gymnasium.make("toy_gym:ToyReach-v0").unwrapped)  # another test may have imported it anew
    own = made.step
    monkeypatch.setattr(made, "step", lambda env, action: own(env, 0 * action))
    asked = EvalConfig(episodes=2, env="toy_gym:ToyReach-v0", env_kwargs=("length=40", "count=99"), threads=1)
    found = evaluate(arm_run, asked)
    said = "2 of 2 failed rollouts get less than 0.2 times as far from their start as demonstrations; cut pauses"
    assert found["faults"][-1].startswith(said)


def test_rollouts_that_start_elsewhere_are_told(arm_run, monkeypatch):
    """Columns in another order: goals of both signs where recordings have a speed of zero."""
    made = type(gymnasium.make("toy_gym:ToyReach-v0").unwrapped)
    own = made._observe
    elsewhere = "rollouts start where no recording does: q2 at "
    asked = {"episodes": 5, "env": "toy_gym:ToyReach-v0", "env_kwargs": ("count=99",), "threads": 1}
    for shift, told in ((0.0, 0), (40.0, 1)):
        monkeypatch.setattr(made, "_observe", lambda env, far=shift: own(env) + [0, far * np.sign(env.goal[0]), 0, 0])
        for found in (evaluate(arm_run, EvalConfig(**asked)), inspect(arm_run, InspectConfig(**asked))):
            assert sum(fault.startswith(elsewhere) for fault in found.get("faults", ())) == told


def test_the_mean_return_stands_beside_success(arm_run):
    found = evaluate(arm_run, EvalConfig(episodes=2, env="toy_gym:ToyReachWon-v0", threads=1))
    assert found["mean_return"] == found["rates"]["success"]["rate"] == 1.0
    assert not any("no episode ended with" in fault for fault in found["faults"])
    assert found["mean_return_interval"] == (1.0, 1.0) and found["ended_early"] == 0


def test_a_task_without_success_has_returns_and_no_advice_about_success(arm_run):
    found = evaluate(arm_run, EvalConfig(episodes=3, env="toy_gym:ToyReachFell-v0", threads=1))
    assert found["rates"]["success"]["rate"] == 0 and found["ended_early"] == 3
    assert [row["return"] for row in found["episode"]] == [3.0] * 3
    run = RunFacts.read(arm_run)
    row = as_text(evaluation_rows(run))["environment"]
    assert "3 rollouts ended before that without success" in row and "mean return 3 (95 % interval 3 to 3)" in row
    assert not [item for item in advice(run) if "success" in item.finding]


def test_an_environment_that_fails_loses_its_own_episode_alone(arm_run):
    found = evaluate(arm_run, EvalConfig(episodes=3, seed=10, env="toy_gym:ToyBreaks-v0", threads=1))
    assert [row["outcome"] for row in found["episode"]] == ["success", "error", "success"]
    assert found["errors"] == [{"seed": 11, "step": 1, "error": "reset: RuntimeError: no place"}]
    assert any("failed by an error of the environment: seed 11, step 1" in fault for fault in found["faults"])


def test_an_episode_that_an_error_ended_is_drawn_up_to_its_last_observation(arm_run):
    for at, frames in ((4, 4), (99, 7)):  # the start, and what three or all six steps led to
        asked = EvalConfig(episodes=1, env="toy_gym:ToyBreaks-v0", env_kwargs=(f"at={at}",), threads=1)
        evaluate(arm_run, asked)
        drawn = load_file(arm_run / "rollouts.safetensors")
        assert [len(drawn[name][0]) for name in ("state", "position")] == [frames, frames]


def test_success_of_an_environment_that_breaks_at_its_first_step_is_not_called_the_reward(arm_run):
    asked = EvalConfig(episodes=2, env="toy_gym:ToyBreaks-v0", env_kwargs=("at=1",), threads=1)
    found = evaluate(arm_run, asked)
    assert found["success"].startswith("success: info['is_success'] or info['success'] if there is one, else")
    assert "2 episodes failed by an error" in found["faults"][0]
    assert not any("info has no success entry" in fault for fault in found["faults"])


def test_an_error_of_the_environment_is_the_first_finding_of_an_inspection(arm_run):
    asked = InspectConfig(episodes=3, seed=10, env="toy_gym:ToyBreaks-v0", env_kwargs=("count=99",), threads=1)
    found = inspect(arm_run, asked)
    assert found["findings"].startswith("1 episodes failed by an error of the environment: seed 11, step 1: reset")
    with pytest.raises(ValueError, match="every episode ended with an error of the environment: 1 episodes failed"):
        inspect(arm_run, replace(asked, episodes=1, seed=11))


def test_an_episode_that_an_error_ended_is_not_in_the_mean_return(arm_run):
    config = EvalConfig(episodes=3, seed=10, env="toy_gym:ToyBreaks-v0", env_kwargs=("terminates=won",), threads=1)
    found = evaluate(arm_run, config)
    assert found["mean_return"] == 1.0 and found["rates"]["success"] == rate([True, False, True])
    row = as_text(evaluation_rows(RunFacts.read(arm_run)))["environment"]
    assert row.endswith("mean return 1 (95 % interval 1 to 1; 1 rollouts that an error ended are left out)")
    found = evaluate(arm_run, replace(config, episodes=1, seed=11))
    assert found["mean_return"] is None and found["left_out_of_return"] == 1


def test_no_more_environments_run_at_a_time_than_asked(arm_run, monkeypatch):
    def refuse(*_, batch_size, **more):
        raise RuntimeError(f"{batch_size} at a time")

    monkeypatch.setattr(closed_loop, "roll_out", refuse)
    with pytest.raises(RuntimeError, match="2 at a time"):
        evaluate(arm_run, EvalConfig(episodes=3, env="toy_gym:ToyReach-v0", num_envs=2, threads=1))


def test_limited_commands_are_those_of_the_rollouts(arm_run, monkeypatch):
    counted = []
    monkeypatch.setattr(closed_loop, "limited_commands", lambda policy: counted.append(policy.limited.tolist()) or {})
    found = evaluate(arm_run, EvalConfig(episodes=2, env="toy_gym:ToyReach-v0", threads=1))
    assert [commands for _, commands in counted] == [sum(row["steps"] for row in found["episode"])] == [12]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"env": "toy_gym:ToyReach-v0", "success_key": "no"}, "has no 'no'"),
        ({"env": "toy_gym:ToyReach-v0", "dataset": "anywhere"}, "the data set 'anywhere'"),
        ({"dataset": "anywhere"}, "the data set 'anywhere'"),
    ],
)
def test_a_refused_evaluation_copies_nothing(asked, said, arm_run, tmp_path):
    with pytest.raises(ValueError, match=said):
        evaluate(arm_run, EvalConfig(out=tmp_path / "copy", threads=1, **asked))
    assert not (tmp_path / "copy").exists()


def test_the_closed_loop_is_inspected_there(arm_run):
    found = inspect(arm_run, InspectConfig(episodes=2, env="toy_gym:ToyReach-v0", threads=1))
    assert found["both"] == rate([True] * 2) and {"plan_to_execution", "distance_to_demonstrations"} <= set(found)
    assert not {"controller_alone", "planner_alone"} & set(found)
    draw_experiments(found, RunFacts.read(arm_run))


def test_rollouts_are_not_overwritten_by_errors_on_recorded_data(arm_run, tmp_path):
    evaluate(arm_run, EvalConfig(episodes=1, env="toy_gym:ToyReach-v0", threads=1))
    with pytest.raises(ValueError, match="eval.json holds rollouts in toy_gym:ToyReach-v0: name another folder"):
        evaluate(arm_run, EvalConfig(threads=1))
    assert evaluate(arm_run, EvalConfig(threads=1, out=tmp_path / "errors"))["kind"] == "offline"


def test_arguments_of_an_environment_are_numbers_with_a_point_at_their_end():
    """Else an environment gets the text 15., and every episode fails."""
    words = ("a=15.", "b=-.5", "c=3", "d=v1.0", "e=[1, 2]", "f=1.2.3", "g=007")
    wanted = {"a": 15.0, "b": -0.5, "c": 3, "d": "v1.0", "e": [1, 2], "f": "1.2.3", "g": "007"}
    assert environment_arguments(words) == wanted


def test_success_keys_are_for_environments(trained_run):
    with pytest.raises(ValueError, match="success_key was given, but no env"):
        evaluate(trained_run, EvalConfig(success_key="is_success"))
    with pytest.raises(ValueError, match="num_envs was given, but no env"):
        evaluate(trained_run, EvalConfig(num_envs=2))
    with pytest.raises(ValueError, match="env_kwargs must be key=value, such as obs_type=state, got 'state'"):
        evaluate(trained_run, EvalConfig(env="x", env_kwargs=("state",)))
    with pytest.raises(ValueError, match="num_envs and batch_size both say"):
        evaluate(trained_run, EvalConfig(env="x", num_envs=2, batch_size=2))


def test_refusals(arm_run):
    before = (arm_run / "config.json").read_bytes()
    with pytest.raises(ValueError, match="rollouts_per_context was given, but an env.* has no contexts"):
        evaluate(arm_run, EvalConfig(env="toy_gym:ToyReach-v0", rollouts_per_context=2))
    with pytest.raises(RunDirectoryError, match="the data set 'anywhere' of .* is not there"):
        evaluate(arm_run, EvalConfig(env="toy_gym:ToyReach-v0", dataset="anywhere"))
    assert (arm_run / "config.json").read_bytes() == before
