# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that a training saved as one file acts the same, and that unusable files raise errors."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from offline_runs import fit_walks, save_arm, train_arm
from tiny_runs import TINY, koap

from torchrl_koap import Agent, Execution, ExecutionConfig, Trained, load_policy
from torchrl_koap.commands.doctor import check_run
from torchrl_koap.modules import MLPDenoiser, StatePlanner
from torchrl_koap.runs.plugins import PluginError
from torchrl_koap.runs.run_directory import RunDirectoryError, copy_run
from torchrl_koap.runs.weights import CheckpointError, load_tensors, save_tensors

PATH = np.random.default_rng(0).normal(size=(9, 4)) / 100 + np.array([0.5, -0.2, 0.5, -0.2])


def actions(policy, path=PATH):
    agent = Agent(policy, seed=5)
    agent.reset()
    return np.stack([agent.act(row) for row in path])


@pytest.fixture(scope="module")
def own():
    trained = fit_walks(3, name="my_arm")
    return replace(trained, config=replace(trained.config, execution=ExecutionConfig(replan_interval=3, blend=0.5)))


def test_a_default_of_float64_changes_no_loaded_policy(trained_run, tmp_path):
    file = Trained.load(trained_run).save(tmp_path / "policy.safetensors")
    expected = actions(load_policy(trained_run))
    torch.set_default_dtype(torch.float64)
    try:
        found = [actions(load_policy(where)) for where in (trained_run, file)]
    finally:
        torch.set_default_dtype(torch.float32)
    for one in found:
        np.testing.assert_array_equal(one, expected)


def test_a_run_as_one_file(trained_run, tmp_path):
    shutil.copytree(trained_run, tmp_path / "run")
    expected = actions(load_policy(tmp_path / "run", strategy="open_loop", replan_interval=2))
    path = Trained.load(tmp_path / "run").save(tmp_path / "elsewhere" / "policy.safetensors")
    shutil.rmtree(tmp_path / "run")
    loaded = load_policy(path, strategy="open_loop", replan_interval=2)
    assert loaded.execution == Execution("open_loop", replan_interval=2, candidates=4) and not loaded.training
    np.testing.assert_array_equal(actions(loaded), expected)
    assert load_policy(str(path)).execution == Execution(candidates=4)


def test_errors_distinguish_unfinished_from_damaged_trainings(trained_run, tmp_path):
    run = copy_run(trained_run, tmp_path / "run")
    (run / "planner.safetensors").unlink()
    with pytest.raises(CheckpointError, match="planner.safetensors is missing"):
        Trained.load(run)
    (run / "summary.json").unlink()
    said = r"run is not finished \(no summary.json\): resume it with `koap train --out .*run --resume`"
    for unfinished in (Trained.load, check_run):
        with pytest.raises(RunDirectoryError, match=said):
            unfinished(run)


def test_a_policy_follows_plans_as_it_was_trained_for_unless_asked(own):
    assert own.policy().execution == own.execution == Execution(replan_interval=3, blend=0.5)
    assert own.policy(Execution("open_loop", blend=0.0)).execution == Execution("open_loop", blend=0.0)
    assert own.policy(ExecutionConfig(blend=0.0)).execution == Execution(replan_interval=3, blend=0.0)
    with pytest.raises(TypeError, match=r"options must be ExecutionConfig\(...\), got int 3"):
        own.policy(3)
    with pytest.raises(ValueError, match="unknown option of an execution 'temprature'; did you mean 'temperature'?"):
        load_policy(own, temprature=0.1)
    assert load_policy(own, blend=0.1).execution == Execution(replan_interval=3, blend=0.1)


def test_a_method_that_samples_actions(demonstrations, tmp_path):
    assert koap("train", "--out", tmp_path / "dp", "--dataset", demonstrations, "--method", "dp", *TINY) == 0
    with pytest.raises(ValueError, match="strategy 'feedback' was asked of method 'dp', which samples actions"):
        load_policy(tmp_path / "dp", strategy="feedback")
    with pytest.raises(ValueError, match=r"blend 0\.2 was asked of method 'dp', which samples actions"):
        load_policy(tmp_path / "dp", blend=0.2)
    loaded = load_policy(Trained.load(tmp_path / "dp").save(tmp_path / "dp.safetensors"), replan_interval=3)
    assert loaded.follower is None and loaded.execution == Execution("open_loop", replan_interval=3, candidates=4)
    np.testing.assert_array_equal(actions(loaded), actions(load_policy(tmp_path / "dp", replan_interval=3)))


def test_an_unregistered_robot(own, tmp_path):
    loaded = Trained.load(own.save(tmp_path / "arm.safetensors"))
    assert loaded.task.name == "my_arm" and loaded.columns == (0, 1) and loaded.execution == own.execution
    np.testing.assert_array_equal(actions(loaded.policy(), PATH[:, :3]), actions(own.policy(), PATH[:, :3]))
    again = Trained.load(loaded.save(tmp_path / "again.safetensors"))
    np.testing.assert_array_equal(actions(again.policy(), PATH[:, :3]), actions(own.policy(), PATH[:, :3]))


def test_a_plugin_that_was_moved_is_taken_from_where_it_is_now(copied_run, tmp_path):
    config = json.loads((copied_run / "config.json").read_text())
    config["run"]["plugins"] = [str(tmp_path / "there" / "mine.py")]
    (copied_run / "config.json").write_text(json.dumps(config))
    with pytest.raises(PluginError, match="there is no plugin file '.*/there/mine.py'; give its present path"):
        Trained.load(copied_run)
    (tmp_path / "mine.py").write_text("LOADED = True\n")
    assert Trained.load(copied_run, plugins=[str(tmp_path / "mine.py")]).planner is not None


def test_files_that_cannot_be_used_are_named(own, trained_run, tmp_path):
    good = own.save(tmp_path / "good.safetensors")
    tensors, about = load_tensors(good)

    def written(name, tensors, about):
        save_tensors(tmp_path / name, tensors, about)
        return tmp_path / name

    def changed(section, **options):
        return about | {"config": about["config"] | {section: about["config"][section] | options}}

    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(good.read_bytes()[:1000])
    half = {name: value for name, value in tensors.items() if not name.startswith("controller.")}
    lost = {name: value for name, value in about.items() if name != "config"}
    code = about | {"task_definition": about["task_definition"] | {"env": "os:system"}}
    plugin = changed("run", plugins=["mine"])
    plugin["config"] = plugin["config"] | {"method": "m"}
    wrong = {
        cut: "cut.safetensors is damaged",
        trained_run / "planner.safetensors": "planner.safetensors is not a policy that Trained.save",
        written("new", tensors, about | {"version": 3}): "new is a policy of format 3, this version reads 2",
        written("half", half, about): r"half \(controller\) does not fit the model: .*Missing key",
        written("wide", tensors, changed("planner", width=16)): r"wide \(planner\) does not fit .*size mismatch",
        written("lost", tensors, lost): "lost cannot be built: entry 'config' is missing",
        written(
            "typo", tensors, changed("planner", widht=16)
        ): "unknown option of planner .widht.; did you mean .width.",
        written("code", tensors, code): "code cannot be built: task 'my_arm' names code in env",
        written(
            "plugin", tensors, plugin
        ): "plugin cannot be built: unknown method 'm'.*; it was made with the plugins mine",
    }
    for path, message in wrong.items():
        with pytest.raises(CheckpointError, match=message):
            load_policy(path)


def test_what_cannot_be_saved_or_executed(own, tmp_path):
    with pytest.raises(IsADirectoryError, match="is a folder; a policy is one file, such as"):
        own.save(tmp_path)
    for part in ("planner", "controller"):
        half = replace(own, **{part: None})
        for make in (half.policy, lambda half=half: half.save(tmp_path / "half.safetensors")):
            with pytest.raises(ValueError, match=f"a policy needs planner and controller: no {part} was trained here"):
                make()
    assert not list(tmp_path.iterdir()), "a file that could not be loaded"


@pytest.mark.parametrize(
    ("options", "layers", "said"),
    [
        ({"relative": False}, {}, "relative False"),
        ({"solver": "ddim", "num_steps": 4}, {}, "solver 'ddim', num_steps 4"),
        ({}, {"depth": 2}, "other layers"),
    ],
)
def test_a_given_planner_is_saved_only_if_a_file_can_restore_it(own, tmp_path, options, layers, said):
    frames, width = own.config.planner.frames, own.task.state_dim
    denoiser = MLPDenoiser(width, frames * width, horizon=14, width=8, **layers)
    planner = StatePlanner(denoiser, state_dim=width, history=frames, **options)
    section = replace(own.config.planner, network="mlp", width=8, octaves=1)
    given = replace(own, planner=planner, config=replace(own.config, planner=section))
    with pytest.raises(ValueError, match=f"planner: it has {said}, which a file does not record"):
        given.save(tmp_path / "policy.safetensors")
    assert not list(tmp_path.iterdir())


def test_a_file_does_not_say_which_labels_were_seen(trained_run, demonstrations, tmp_path):
    trained = Trained.load(trained_run)
    loaded = Trained.load(trained.save(tmp_path / "policy.safetensors"))
    for half, name in ((loaded, "policy.safetensors"), (replace(loaded, folder=None), "a training in memory")):
        with pytest.raises(RunDirectoryError, match=f"{name} does not record which labels were seen: wanted a run of"):
            half.hide_labels(loaded.data(str(demonstrations)))


def test_a_training_is_shown_in_one_line(own, trained_run):
    assert repr(own) == "Trained(task='my_arm', method='linear', folder=None)"
    assert repr(Trained.load(trained_run)) == f"Trained(task='avoiding', method='koap', folder='{trained_run}')"


def test_labels_of_other_values_are_not_those_of_the_training(tmp_path):
    arm = save_arm(tmp_path / "arm")
    trained = Trained.load(train_arm(tmp_path / "run", arm, method="linear"))
    data = trained.data()
    outside = data["episode"] >= 3
    data["action"][outside] *= -1  # these were never read
    assert trained.hide_labels(data)[1].trajectories_touched == 3
    data["action"][~outside] *= -1
    with pytest.raises(RunDirectoryError, match="trajectories or labels differ; train again with it"):
        trained.hide_labels(data)
