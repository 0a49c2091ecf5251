# This source code is licensed under the MIT license found in the LICENSE file.
"""From a folder of arrays with few labels to a trained, exported policy by commands alone."""

from __future__ import annotations

import json
from functools import partial

import numpy as np
import pytest
from tiny_runs import koap

from torchrl_koap.commands import run_commands
from torchrl_koap.data import load_ted, stored_task
from torchrl_koap.evaluation import load_policy
from torchrl_koap.modules import Agent
from torchrl_koap.tasks import Action

TINY = ("--steps", 20, "--planner.batch-size", 8, "--planner.width", 8, "--controller.steps", 20)


@pytest.fixture(scope="module")
def arrays(tmp_path_factory):
    """Six trajectories of a two-joint arm that reaches for a goal; two have actions."""
    folder, generator = tmp_path_factory.mktemp("arrays"), np.random.default_rng(0)
    for index in range(6):
        joints, goal, velocity = generator.uniform(-1, 1, 2), generator.uniform(-1, 1, 2), np.zeros(2)
        frames, steps = [], []
        for _ in range(30):
            frames.append(np.r_[joints, goal])
            steps.append(0.2 * (goal - joints))
            velocity = 0.5 * velocity + 0.5 * steps[-1]
            joints = joints + velocity
        content = {"states": np.array(frames), "state_names": ["q1", "q2", "goal1", "goal2"], "control_hz": 20.0}
        if index < 2:
            content |= {"actions": np.array(steps), "action_names": ["dq1", "dq2"]}
        np.savez(folder / f"run_{index}.npz", **content)
    return folder


@pytest.fixture(scope="module")
def run(arrays, tmp_path_factory):
    root = tmp_path_factory.mktemp("own")
    assert koap("convert", arrays, "--out", root / "arm", "--robot", "q1", "q2", "--action-units", "rad") == 0
    assert koap("train", "--dataset", root / "arm", "--out", root / "run", *TINY, "--planner.network", "mlp") == 0
    return root / "run"


def test_the_task_comes_with_the_data(run):
    task = stored_task(run.parent / "arm" / "ted")
    assert task.name == "arm" and task.robot == (0, 1) and task.actions == {"dq1": Action("rad"), "dq2": Action("rad")}
    config, summary = (json.loads((run / name).read_text()) for name in ("config.json", "summary.json"))
    assert config["task"] == "arm" and config["labels"]["fraction"] == 1.0
    assert summary["labels"]["labelled_transitions"] == 58 and summary["labels"]["selected_units"] == 2


def test_a_policy_acts_on_the_users_observations(run):
    agent = Agent(load_policy(run))
    agent.reset()
    action = agent.act(np.zeros(4))
    assert action.shape == (2,) and np.isfinite(action).all()
    with pytest.raises(ValueError, match="task 'arm' has 4 columns, got 5"):
        agent.reset()
        agent.act(np.zeros(5))


def test_resume_goes_on_with_the_labels_of_before(run, capsys):
    assert koap("train", "--out", run, "--resume") == 0
    assert koap("train", "--out", run, "--resume", "--labels.fraction", 0.5) == 1
    assert "was started with another labels.fraction" in capsys.readouterr().err


def test_absolute_targets(arrays, tmp_path):
    (tmp_path / "arrays").mkdir()
    for file in arrays.iterdir():
        content = dict(np.load(file))
        if "actions" in content:
            content["actions"] = content["states"][:, :2] + content["actions"]
        np.savez(tmp_path / "arrays" / file.name, **content)
    command = ("convert", tmp_path / "arrays", "--out", tmp_path / "arm", "--name", "reach", "--robot", "q1", "q2")
    assert koap(*command, "--action-kind", "absolute") == 0
    assert koap("train", "--dataset", tmp_path / "arm", "--out", tmp_path / "run", "--method", "linear", *TINY) == 0
    data, _ = load_ted(tmp_path / "arm" / "ted")
    agent = Agent(load_policy(tmp_path / "run", limits=float("inf")))
    agent.reset()
    far = data["observation"][0].numpy() + np.array([5.0, 5.0, 5.0, 5.0])
    near = agent.act(data["observation"][0].numpy())
    agent.reset()
    moved = agent.act(far)
    # what is learnt is the distance to the target: a robot that starts elsewhere is sent elsewhere
    assert np.abs(moved - near).min() > 2
    limited = Agent(load_policy(tmp_path / "run"))  # by default not that far
    limited.reset()
    assert limited.act(far).max() < moved.max() and limited.policy.limited.tolist() == [1, 1]


def test_a_missing_data_set_is_named(run, tmp_path, capsys):
    assert koap("train", "--dataset", "nowhere", "--out", tmp_path / "run") == 1
    assert "dataset 'nowhere' is no folder of" in capsys.readouterr().err
    assert koap("train", "--dataset", run.parent / "arm", "--out", tmp_path / "run", "--task", "arn") == 1
    assert "arn does not fit" in capsys.readouterr().err


def test_export_and_latency(run, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(run_commands, "time_calls", partial(run_commands.time_calls, repeats=3))
    assert koap("export", run, "--out", tmp_path / "exported") == 0
    assert {file.name for file in (tmp_path / "exported").iterdir()} == {
        "policy.pt2",
        "controller.pt2",
        "denoiser.pt2",
    }
    assert "policy ms eager" in capsys.readouterr().out
    assert koap("latency", run, "--steps", 10) == 0
    assert "late_steps" in capsys.readouterr().out
    assert koap("latency", run, "--steps", 10, "--async-replan") == 0


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (("convert", "nowhere", "--out", "x"), "nowhere does not exist"),
        (("latency", "nowhere"), "nowhere"),
        (("export", "nowhere", "--format", "onxx"), "unknown export format 'onxx'; did you mean 'onnx'"),
    ],
)
def test_faults_are_one_line(command, message, capsys):
    assert koap(*command) == 1
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_the_task_of_the_data_is_not_another(run, capsys, tmp_path):
    dataset = run.parent / "arm"
    assert koap("train", "--task", "avoiding", "--dataset", dataset, "--out", tmp_path / "run", *TINY) == 1
    assert "holds its own task 'arm'; --task avoiding does not fit it" in capsys.readouterr().err
