# This source code is licensed under the MIT license found in the LICENSE file.
"""A closed loop on the labels finds a policy whose commands grow, and says where labels do not allow one."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_koap import ExecutionConfig, fit
from torchrl_koap.data import make_demonstrations
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
    assert found["steps"] == 120 and found["robots"] == 8 and found["explained"] > 0.999
    assert found["largest_command"] < 3 and found["faults"] == []
    assert found["limited_commands"] == 0 and found["commands"] == 8 * 120
    assert found["distance_to_demonstrations"] < 0.5 and json.dumps(found)


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


def test_goals_are_no_inputs_of_the_robot():
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
    assert "of its motion, which is too little" in found["note"] and found["faults"] == []
