# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the folder that LeRobot reads; tests of its plugin run it with LeRobot."""

import json
from dataclasses import replace

import numpy as np
import pytest
from camera_sets import write_filmed
from offline_runs import fit_walks
from tiny_runs import koap

from torchrl_koap import Agent, load_policy
from torchrl_koap.training.lerobot_folder import WEIGHTS, number_features, write_lerobot_folder
from torchrl_koap.vision.embedding import embed_recordings, read_sources

NAMES = ("x", "y", "environment_state_0", "environment_state_tip")


@pytest.fixture(scope="module")
def trained():
    return fit_walks(4, state_names=NAMES)


def read(file):
    return json.loads(file.read_text())


def test_the_folder_describes_the_columns_and_acts_as_the_training(trained, tmp_path):
    said = write_lerobot_folder(trained, tmp_path / "a b")
    config = read(tmp_path / "a b" / "config.json")
    assert config["type"] == "koap" and list(config["input_features"].items()) == [
        ("observation.state", {"type": "STATE", "shape": [2]}),
        ("observation.environment_state", {"type": "ENV", "shape": [2]}),
    ]
    assert config["output_features"] == {"action": {"type": "ACTION", "shape": [2]}}
    assert said["observation.environment_state"] == "environment_state_0, environment_state_tip"
    assert f"--policy.path='{tmp_path}/a b'" in said["next"]
    actions = []
    for policy in (trained.policy(), load_policy(tmp_path / "a b" / WEIGHTS)):
        agent = Agent(policy, seed=3)
        agent.reset()
        actions.append([agent.act(np.full(4, 0.1 * step)) for step in range(6)])
    np.testing.assert_array_equal(*actions)
    for name, steps in {"preprocessor": 3, "postprocessor": 1}.items():
        pipeline = read(tmp_path / "a b" / f"policy_{name}.json")
        assert pipeline["name"] == f"policy_{name}" and len(pipeline["steps"]) == steps


def test_columns_of_a_feature_that_lie_apart_are_named(trained, tmp_path):
    parts = {"robot": ("x",), "surroundings": ("environment_state_0",), "robot_2": ("y", "z")}
    apart = replace(trained, task=replace(trained.task, observation_parts=parts, observation_origin=()))
    with pytest.raises(ValueError, match=r"columns of observation.state are not adjacent \(y\): convert the data"):
        number_features(apart)


def test_frames_are_features_by_camera(tmp_path):
    write_filmed(tmp_path / "raw", cameras=("image", "wrist"))
    assert koap("convert", tmp_path / "raw", "--out", tmp_path / "own", "--quiet") == 0
    options = {"network": "tiny_network:random_layer", "components": 5}
    embed_recordings(*read_sources([tmp_path / "own"], None), tmp_path / "seen", **options)
    run = tmp_path / "run"
    steps = ("--planner.steps", "2", "--planner.width", "8", "--method", "linear", "--quiet")
    assert koap("train", "--dataset", tmp_path / "seen", "--out", run, *steps) == 0
    assert koap("export", run, "--format", "lerobot", "--quiet") == 0
    features = read(run / "exported" / "config.json")["input_features"]
    assert features == {
        "observation.state": {"type": "STATE", "shape": [2]},
        "observation.image": {"type": "VISUAL", "shape": [3, 16, 24]},
        "observation.images.wrist": {"type": "VISUAL", "shape": [3, 16, 24]},
    }


def test_a_run_is_not_overwritten(copied_run, tmp_path, capsys):
    before = (copied_run / "config.json").read_bytes()
    assert koap("export", copied_run, "--format", "lerobot", "--out", copied_run) == 1
    assert f"{copied_run}/config.json is not LeRobot's: choose another --out" in capsys.readouterr().err
    assert (copied_run / "config.json").read_bytes() == before and not (copied_run / WEIGHTS).exists()
    assert koap("export", copied_run, "--format", "lerobt") == 1
    assert "lerobot" in capsys.readouterr().err
    for _ in range(2):  # the second replaces the first
        assert koap("export", copied_run, "--format", "lerobot", "--out", tmp_path / "out", "--quiet") == 0
