# This source code is licensed under the MIT license found in the LICENSE file.
"""A policy as one file acts as the policy did, and files that cannot be used are named."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import TINY, koap

from torchrl_koap import Agent, build_policy, fit_controller, fit_planner, load_policy, save_policy
from torchrl_koap.data import make_demonstrations
from torchrl_koap.evaluation.policy_files import PolicyDescription
from torchrl_koap.evaluation.trained_run import load_run
from torchrl_koap.modules import Execution, make_policy
from torchrl_koap.runs.weights import CheckpointError, load_tensors, save_tensors
from torchrl_koap.tasks import get_task

PATH = np.random.default_rng(0).normal(size=(9, 4)) / 100 + np.array([0.5, -0.2, 0.5, -0.2])


def actions(policy, path=PATH):
    agent = Agent(policy, seed=5)
    agent.reset()
    return np.stack([agent.act(row) for row in path])


@pytest.fixture(scope="module")
def own_policy():
    random = np.random.default_rng(0)
    states = [random.normal(size=(40, 3)).cumsum(0) for _ in range(3)]
    data, task = make_demonstrations(
        states, [np.diff(states[0][:, :2], axis=0), None, None], control_hz=30, name="my_arm", robot=[0, 1]
    )
    planner = fit_planner(data, task, steps=2, channels=(8, 16), progress=False)
    controller = fit_controller(data, task, method="linear", progress=False)
    return build_policy(planner, controller, replan_interval=3, blend=0.5)


def test_a_run_as_one_file(trained_run, tmp_path):
    shutil.copytree(trained_run, tmp_path / "run")
    policy = load_policy(tmp_path / "run", strategy="open_loop", replan_interval=2)
    expected = actions(policy)
    path = save_policy(policy, tmp_path / "elsewhere" / "policy.safetensors")
    shutil.rmtree(tmp_path / "run")
    loaded = load_policy(path)
    assert loaded.execution == Execution("open_loop", replan_interval=2) and not loaded.training
    np.testing.assert_array_equal(actions(loaded), expected)
    assert load_policy(str(path), replan_interval=4).execution == Execution("open_loop")


def test_a_policy_that_is_built_follows_plans_as_its_task_says(own_policy):
    planner, controller, task = own_policy.planner, own_policy.follower.controller, own_policy.description.task
    task = replace(task, defaults=replace(task.defaults, execution={"strategy": "open_loop", "blend": 0.0}))
    assert build_policy(planner, controller, task).execution == Execution("open_loop", blend=0.0)
    asked = build_policy(planner, controller, task, strategy="feedback", replan_interval=2)
    assert asked.execution == Execution(replan_interval=2, blend=0.0)


def test_asked_goes_before_the_run_the_method_the_task_and_the_library(trained_run):
    trained = load_run(trained_run)
    assert load_policy(trained).execution == Execution()
    own = {"strategy": "open_loop", "replan_interval": 8, "blend": 0.0}
    trained = replace(trained, task=replace(trained.task, defaults=replace(trained.task.defaults, execution=own)))
    assert load_policy(trained).execution == Execution(**own)
    method = replace(trained.method, execution={"strategy": "feedback", "blend": 0.5})
    trained = replace(trained, method=method)
    assert load_policy(trained).execution == Execution(replan_interval=8, blend=0.5)
    several = replace(trained, config=trained.config | {"candidates": 3})
    assert load_policy(several).execution.candidates == 3
    assert load_policy(several, blend=0.0, candidates=2).execution == Execution(
        replan_interval=8, blend=0.0, candidates=2
    )
    assert get_task("scooping").defaults.execution == own


def test_a_policy_of_its_own(demonstrations, tmp_path):
    assert koap("train", "--out", tmp_path / "dp", "--dataset", demonstrations, "--method", "dp", *TINY) == 0
    with pytest.raises(ValueError, match="strategy 'feedback' was asked of method 'dp', which samples actions"):
        load_policy(tmp_path / "dp", strategy="feedback")
    policy = load_policy(tmp_path / "dp", replan_interval=3)
    loaded = load_policy(save_policy(policy, tmp_path / "dp.safetensors"))
    assert loaded.follower is None and loaded.execution == Execution("open_loop", replan_interval=3)
    np.testing.assert_array_equal(actions(loaded), actions(policy))


def test_a_robot_that_nobody_registered(own_policy, tmp_path):
    loaded = load_policy(save_policy(own_policy, tmp_path / "arm.safetensors"))
    assert loaded.description.task.name == "my_arm" and loaded.description.columns == (0, 1)
    assert loaded.execution == Execution(replan_interval=3, blend=0.5)
    np.testing.assert_array_equal(actions(loaded, PATH[:, :3]), actions(own_policy, PATH[:, :3]))
    again = load_policy(save_policy(loaded, tmp_path / "again.safetensors"))
    np.testing.assert_array_equal(actions(again, PATH[:, :3]), actions(own_policy, PATH[:, :3]))


def test_absolute_targets_come_back(tmp_path):
    states = [np.random.default_rng(index).normal(size=(40, 2)).cumsum(0) for index in range(3)]
    data, task = make_demonstrations(
        states, [states[0][1:], None, None], control_hz=30, action_kind="absolute", targets=[0, 1]
    )
    planner = fit_planner(data, task, steps=2, channels=(8, 16), progress=False)
    policy = build_policy(planner, fit_controller(data, task, method="linear", progress=False))
    loaded = load_policy(save_policy(policy, tmp_path / "arm.safetensors"))
    far = PATH[:, :2] + 1000
    np.testing.assert_array_equal(actions(loaded, far), actions(policy, far))
    assert np.abs(actions(loaded, far) - far).max() < 500  # near where it is, not near 0


def test_files_that_cannot_be_used_are_named(own_policy, trained_run, tmp_path):
    good = save_policy(own_policy, tmp_path / "good.safetensors")
    tensors, about = load_tensors(good)

    def written(name, tensors, about):
        save_tensors(tmp_path / name, tensors, about)
        return tmp_path / name

    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(good.read_bytes()[:1000])
    half = {name: value for name, value in tensors.items() if not name.startswith("controller.")}
    wide = about | {"planner": about["planner"] | {"channels": [16, 8]}}
    lost = {name: value for name, value in about.items() if name != "columns"}
    code = about | {"task_definition": about["task_definition"] | {"env": "os:system"}}
    wrong = {
        cut: "cut.safetensors is damaged",
        trained_run / "planner.safetensors": "planner.safetensors is no policy that save_policy",
        written("new", tensors, about | {"version": 2}): "new is a policy of format 2, this version reads 1",
        written("half", half, about): "half: the weights do not fit the controller: .*Missing key",
        written("wide", tensors, wide): "wide: the weights do not fit the planner: .*size mismatch",
        written("lost", tensors, lost): "lost cannot be built: entry 'columns' is missing",
        written("code", tensors, code): "code cannot be built: task 'my_arm' names code in env",
        written("plugin", tensors, about | {"plugins": ["mine"], "controller": {"method": "m", "preset": "default"}}): (
            "plugin cannot be built: unknown method 'm'.*; it was made with the plugins mine"
        ),
    }
    for path, message in wrong.items():
        with pytest.raises(CheckpointError, match=message):
            load_policy(path)


def test_what_cannot_be_saved(own_policy, trained_run, tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder; a policy is one file, such as"):
        save_policy(own_policy, tmp_path)
    bare = make_policy(own_policy.planner, own_policy.follower.controller, state_of=(0, 1, 2), columns=(0, 1))
    with pytest.raises(TypeError, match="wanted a policy of load_policy.. or build_policy.., got another PlanningPol"):
        save_policy(bare, tmp_path / "bare.safetensors")
    assert not list(tmp_path.iterdir())


def test_networks_of_different_robots_make_no_policy(own_policy):
    states = [np.random.default_rng(index).normal(size=(40, 2)).cumsum(0) for index in range(3)]
    data, task = make_demonstrations(states, [np.diff(states[0], axis=0), None, None], control_hz=30)
    controller = fit_controller(data, task, method="linear", progress=False)
    with pytest.raises(ValueError, match="the controller was fitted for other columns than those of task 'my_arm'"):
        build_policy(own_policy.planner, controller)
    with pytest.raises(TypeError, match="the planner must be one that fit_planner returned"):
        build_policy(torch.nn.Linear(1, 1), controller)
    assert isinstance(own_policy.description, PolicyDescription)
