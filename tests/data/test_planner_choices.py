# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the choice of the frames that a planner of recorded data observes."""

import numpy as np
import pytest
import torch
from env_test_base import HUMAN

from torchrl_koap import PlannerConfig, TrainConfig
from torchrl_koap.data import make_demonstrations, open_dataset, save_demonstrations, select_state
from torchrl_koap.data.planner_choices import motion_gain, observed_frames, planner_updates
from torchrl_koap.data.sources import find_task_of
from torchrl_koap.tasks import WINDOW, get_task
from torchrl_koap.training.defaults import resolve

FRAMES, NUMBER = 40, 30


def reaching(generator):
    """A hand that goes to one place: where it is tells where it goes."""
    rows = [generator.uniform(-1, 1, 2)]
    for _ in range(FRAMES - 1):
        rows.append(0.93 * rows[-1])
    return np.array(rows)


def crossing(generator):
    """Straight routes of all directions through one area: only the motion tells which one is taken."""
    angle, aside = generator.uniform(0, 2 * np.pi), generator.normal(0, 0.05)
    along = np.linspace(-1, 1, FRAMES)[:, None]
    way = np.array([np.cos(angle), np.sin(angle)])
    return along * way + aside * np.array([-way[1], way[0]])


def described(states, **description):
    """Returns data with ``state``, and their task."""
    data, task = make_demonstrations(states, control_hz=30, action_dim=2, **description)
    return select_state(data, task.state_of), task


def recorded(motion):
    generator = np.random.default_rng(0)
    return [motion(generator) for _ in range(NUMBER)]


@pytest.mark.parametrize(("motion", "frames"), [(reaching, 1), (crossing, 2)])
def test_two_frames_are_observed_where_the_motion_tells_the_route(motion, frames, tmp_path):
    chosen, why = observed_frames(*described(recorded(motion)))
    assert chosen == frames
    assert why.startswith(f"{frames} frame{'s' * (frames > 1)}: knowing the last change divides the error")
    folder = save_demonstrations(tmp_path / "arm", recorded(motion), control_hz=30, action_dim=2)
    task = find_task_of(str(folder), None)
    assert resolve(TrainConfig(out=tmp_path), task).planner.frames == frames
    for method, asked, wanted in (("koap", 3 - frames, 3 - frames), ("dp", None, 2)):
        config = TrainConfig(out=tmp_path, method=method, planner=PlannerConfig(frames=asked))
        assert resolve(config, task).planner.frames == wanted


def test_only_the_robot_s_columns_are_predicted():
    generator = np.random.default_rng(1)
    states = [np.c_[reaching(generator), crossing(generator)] for _ in range(NUMBER)]
    gains = [motion_gain(*described(states, robot=robot)) for robot in ([0, 1], [2, 3])]
    assert gains[0] < 2 < gains[1]


def test_other_windows_of_the_same_trajectory_predict_nothing():
    """On a straight route they would predict it exactly, once the direction is known."""
    assert 2 < motion_gain(*described(recorded(crossing))) < 100


def test_units_do_not_count():
    data, task = described(recorded(crossing))
    scaled = data.copy().set("state", data["state"] * torch.tensor([1e3, 1e-3]))
    assert motion_gain(data, task) == pytest.approx(motion_gain(scaled, task), 1e-3)


@pytest.mark.parametrize(("number", "length"), [(1, FRAMES), (2, WINDOW)])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_without_two_trajectories_as_long_as_a_window_two_frames_are_observed(number, length):
    states = [np.random.default_rng(row).normal(size=(length, 2)).cumsum(0) for row in range(number)]
    _, task = described(states)
    assert task.defaults.planner["frames"] == 2


@pytest.mark.parametrize("length", [WINDOW + 1, WINDOW + 3])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_two_trajectories_as_long_as_a_window_are_enough(length):
    states = [np.random.default_rng(row).normal(size=(length, 2)).cumsum(0) for row in range(2)]
    assert "divides the error" in observed_frames(*described(states))[1]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_route_that_is_taken_both_ways_has_two_frames():
    there = np.linspace(0, 1, FRAMES)[:, None] * np.array([1.0, 0.5])
    assert observed_frames(*described([there, there[::-1]] * 6))[0] == 2


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_robot_that_rests_has_one_frame():
    _, task = described([np.zeros((FRAMES, 3))] * 3, robot=[0, 1])
    assert task.defaults.planner["frames"] == 1


@pytest.mark.skipif(not HUMAN.exists(), reason=f"no human demonstrations at {HUMAN}")
def test_human_demonstrations_of_avoiding_have_two_frames():
    task = get_task("avoiding")
    data, _ = open_dataset(HUMAN, task=task)
    assert observed_frames(data, task)[0] == 2


@pytest.mark.parametrize(("steps", "updates"), [(2000, 3000), (25_444, 3000), (35_865, 4000), (185_026, 12_000)])
def test_more_recorded_steps_get_more_updates(steps, updates):
    assert planner_updates(steps) == (
        updates,
        f"at most {updates:,} updates: one for 8 recorded steps, from 3,000 to 12,000",
    )


def test_own_data_train_for_the_updates_that_their_size_asks_for(tmp_path):
    task = described([np.random.default_rng(0).normal(size=(40_000, 2)).cumsum(0)] * 2)[1]
    assert resolve(TrainConfig(out=tmp_path), task).planner.steps == 10_000
    asked = TrainConfig(out=tmp_path, planner=PlannerConfig(steps=500, network="unet"))
    assert resolve(asked, task).planner.steps == 500
