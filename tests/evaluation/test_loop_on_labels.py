# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the closed loop on labels: it finds policies with growing commands, and names unsuitable labels."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_koap import ExecutionConfig, fit
from torchrl_koap.data import LabelBudget, make_demonstrations, select_state
from torchrl_koap.evaluation import loop_on_labels
from torchrl_koap.evaluation.loop_on_labels import check_loop

SMALL = {"planner": {"network": "mlp", "steps": 600, "batch_size": 64, "width": 64}, "controller": {"steps": 0}}


def recordings(noise=0.0):
    """Two joints that go 3 % of the way to one goal in every frame, by commands in twice their units."""
    random = np.random.default_rng(0)
    goal, starts = random.uniform(-1, 1, 2), random.uniform(-1, 1, (8, 2))
    states = [goal + 0.97 ** np.arange(80)[:, None] * (start - goal) for start in starts]
    actions = [2 * np.diff(rows, axis=0) + noise * random.normal(size=(79, 2)) for rows in states]
    return make_demonstrations(states, actions[:4] + [None] * 4, control_hz=100)


@pytest.fixture(scope="module")
def trained():
    data, task = recordings()
    return fit(data, task, **SMALL, progress=False), data


def test_a_policy_that_goes_to_the_goal(trained):
    found = check_loop(*trained, trained[1])
    assert found["steps"] == 120 and found["robots"] == 8 and found["explained"] > 1 - 1e-9
    assert 0.6 < found["largest_command"] < 1.2 and found["faults"] == []
    assert found["largest_command_late"] < 0.3 * found["largest_command"]
    assert found["limited_commands"] == 0 and found["commands"] == 8 * 120
    assert found["distance_to_demonstrations"] < 0.5 and json.dumps(found)


def test_labels_of_first_steps_alone_show_no_change(trained):
    model, data = trained
    first = data.clone().set("has_action", data["has_action"] & (data["step_count"].reshape(-1, 1) == 0))
    assert check_loop(model, first, first) == {"note": "no command changes in the labels", "faults": []}


def test_scattered_labels_are_not_called_wrong_actions(trained):
    model, data = trained
    pairs = data.clone().set("has_action", data["has_action"] & (data["step_count"].reshape(-1, 1) % 3 != 0))
    note = "no recording has three labelled steps in a row, so no actions can be replayed"
    assert check_loop(model, pairs, pairs) == {"note": note, "faults": []}


def test_replayed_actions_do_not_continue_behind_a_gap_in_the_labels(trained, monkeypatch):
    monkeypatch.setattr(loop_on_labels, "STEPS", 30)
    model, data = trained
    step = data["step_count"].reshape(-1, 1)
    apart = data.clone().set("has_action", data["has_action"] & ((step < 5) | (step > 73)))
    assert "note" not in check_loop(model, apart, apart)


def test_commands_are_counted_in_those_of_the_budget_and_noise_is_that_of_the_seed(trained, monkeypatch):
    monkeypatch.setattr(loop_on_labels, "STEPS", 30)
    model, data = trained
    few, _ = LabelBudget(episodes=[2]).apply(data)
    largest = [each["action"][each["has_action"].squeeze(-1)].abs().max().item() for each in (few, data)]
    found, again, other = (check_loop(model, data, each, seed=s) for each, s in ((data, 0), (few, 0), (data, 1)))
    assert again["largest_command"] == pytest.approx(found["largest_command"] * largest[1] / largest[0])
    assert again["distance_to_demonstrations"] == found["distance_to_demonstrations"]
    assert other["distance_to_demonstrations"] != found["distance_to_demonstrations"]


def test_motion_goes_on_from_the_step_before_and_not_from_another_recording(trained, monkeypatch):
    monkeypatch.setattr(loop_on_labels, "STEPS", 30)
    random, states, actions = np.random.default_rng(0), [], []
    for _ in range(20):
        commands, speeds = random.normal(size=(18, 2)), [random.normal(size=2)]
        for command in commands:
            speeds.append(0.6 * speeds[-1] + 0.4 * command)
        states.append(np.cumsum([random.normal(size=2), *speeds[1:]], axis=0)), actions.append(commands)
    data, _ = make_demonstrations(states, actions, control_hz=100)
    assert check_loop(trained[0], data, data)["explained"] > 1 - 1e-6


def test_origins_are_added_before_a_policy_reads_and_subtracted_from_what_it_commands():
    data, _ = recordings()
    states = [1e7 + data["observation"][data["episode"] == number].double().numpy() for number in range(8)]
    targets = [rows[:-1] + 2 * np.diff(rows, axis=0) for rows in states]
    options, found = {"control_hz": 100, "action_kind": "absolute", "targets": [0, 1], "max_steps": 20}, []
    origin = make_demonstrations(states, targets, **options)[1].observation_origin
    few = SMALL | {"planner": SMALL["planner"] | {"steps": 3}}
    for moved in (0.0, np.array(origin)):
        data, task = make_demonstrations([x - moved for x in states], [x - moved for x in targets], **options)
        data = select_state(data, task.state_of)
        found.append(check_loop(fit(data, task, **few, progress=False), data, data))
        assert (task.origins is None) == bool(np.any(moved))
    far, near = ({name: value for name, value in each.items() if name != "faults"} for each in found)
    assert far == pytest.approx(near, rel=1e-5) and far["commands"] > 0


@pytest.mark.filterwarnings("error:in episode")  # the report tells how far it gets
def test_a_policy_that_overshoots_ever_more_is_unstable(trained):
    model, data = trained
    grown = replace(model, planner=copy.deepcopy(model.planner))
    with torch.no_grad():
        grown.planner.plan_normalizer.scale *= 1000  # plans go as many times as far
    found = check_loop(grown, data, data)
    assert found["largest_command_late"] > 100 and found["limited_commands"] > 100
    assert found["faults"][0].startswith("this policy is unstable: on a linear model of the robot, commands grow to")
    free = check_loop(grown, data, data, execution=ExecutionConfig(limits=float("inf")))
    assert free["limited_commands"] == 0 and free["distance_to_demonstrations"] > found["distance_to_demonstrations"]


def test_a_policy_that_stays_where_it_is(trained):
    model, data = trained
    assert check_loop(model, data, data)["share_of_way"] > 0.8
    found = check_loop(model, data, data, execution=ExecutionConfig(gain=0.01))
    assert found["share_of_way"] < 0.2
    assert found["faults"][0].startswith("this policy does not leave the start: on a linear model of the robot")


def test_goals_do_not_enter_the_response_of_the_robot():
    """Three joints follow commands with a lag and less than they are told; goals differ by recording alone."""
    random, states, actions = np.random.default_rng(0), [], []
    for _ in range(30):
        place, goal, speed = random.uniform(-1, 1, 3), random.uniform(-1, 1, 3), 0
        frames, commands = [], []
        for _ in range(60):
            frames.append(np.r_[place, 100 * goal])
            commands.append(0.1 * (goal - place) + 0.01 * random.normal(size=3))
            speed = 0.6 * speed + 0.4 * commands[-1]
            place = place + 0.05 * np.tanh(speed / 0.05)
        states.append(np.array(frames)), actions.append(np.array(commands))
    data, task = make_demonstrations(states, actions[:5] + [None] * 25, control_hz=30, robot=range(3))
    found = check_loop(fit(data, task, **SMALL, progress=False), data, data)
    assert "note" not in found and found["explained"] > 0.8


def test_labels_that_say_little_are_named(trained):
    noisy = recordings(noise=1.0)[0]
    noisy["next", "observation"] = noisy["observation"] + torch.randn(noisy["observation"].shape)
    found = check_loop(trained[0], noisy, noisy)
    assert "of how all state columns change, which is too little" in found["note"] and found["faults"] == []
