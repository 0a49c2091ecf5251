# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the detection of labels logged after the motion that they cause, and of robots that respond late."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_koap.data import make_demonstrations, make_recordings
from torchrl_koap.data.formats.resampling import resampled
from torchrl_koap.data.late_labels import frames_late

JOINTS, FRAMES = 3, 80


def recordings(late=0, **how):
    """Data and task of an arm."""
    return make_demonstrations(*unsteady(late, **how), control_hz=30, action_kind=how.get("kind", "delta"))


def unsteady(late=0, *, lag=0.4, delay=0, noise=0.0, kind="delta", labelled=5):
    """States and actions of an arm that follows steps ``[T, 3]``, or targets, of an operator with unsteady hands."""
    generator, states, actions = np.random.default_rng(0), [], []
    for number in range(6):
        place, speed, command, given = np.zeros(JOINTS), np.zeros(JOINTS), np.zeros(JOINTS), []
        frames = []
        for _ in range(FRAMES):
            frames.append(place + noise * generator.normal(size=JOINTS))
            command = 0.9 * command + generator.normal(0, 0.01, JOINTS)
            given.append(command if kind != "absolute" else place + 3 * command)
            caused = given[-1 - delay] if len(given) > delay else 0 * command
            wanted = caused if kind != "absolute" else 0.3 * (caused - place)
            speed = lag * speed + (1 - lag) * wanted
            place = place + speed
        logged = np.full((FRAMES, JOINTS), np.nan)
        logged[max(late, 0) : FRAMES + min(late, 0)] = np.array(given)[max(-late, 0) : FRAMES - max(late, 0)]
        states.append(np.array(frames))
        actions.append(logged if number < labelled else None)
    return states, actions


@pytest.mark.parametrize("lag", [0.0, 0.8])
@pytest.mark.parametrize("late", [1, 3])
@pytest.mark.parametrize(("kind", "noise"), [("delta", 0.0), ("delta", 0.001), ("absolute", 0.0), ("absolute", 0.001)])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_labels_that_are_late_are_counted(late, lag, kind, noise):
    assert frames_late(*recordings(late, lag=lag, kind=kind, noise=noise)) == late


@pytest.mark.parametrize(
    "how",
    [{}, {"lag": 0.0}, {"lag": 0.8}, {"delay": 2}, {"noise": 0.001}, {"noise": 0.1}, {"kind": "absolute"}]
    + [{"labelled": 1}, {"late": -2}, {"late": 1, "delay": 1}, {"late": 1, "kind": "raw"}],
)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_labels_on_time_or_early_within_a_robot_s_delay_or_without_a_column_are_no_fault(how):
    assert frames_late(*recordings(**how)) == 0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_features_of_other_width_than_their_columns_may_precede_the_robot_s():
    data, task = recordings(2)
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(data), 4)
    data["observation"] = torch.cat([turns, data["observation"]], 1)
    parts = {"turn": 4, "joints": JOINTS}
    state, robot = {"turn": "quaternion", "joints": "plain"}, tuple(column + 2 for column in task.robot)
    task = replace(task, observation_parts=parts, observation_units=(), position="joints", state=state, robot=robot)
    assert frames_late(data, task) == 2


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_delay_of_the_robot_hides_as_many_frames():
    assert frames_late(*recordings(3, delay=1)) == 2


@pytest.mark.parametrize(("kind", "noise"), [("delta", 0.0003), ("absolute", 0.003)])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_script_that_reacts_to_noisy_states_is_on_time(kind, noise):
    generator, states, actions = np.random.default_rng(0), [], []
    for _ in range(6):
        place, goal = generator.uniform(-1, 1, (2, 2))
        seen, given = [], []
        for _ in range(FRAMES):
            seen.append(np.r_[place + noise * generator.normal(size=2), goal])
            step = 0.1 * (goal - seen[-1][:2])
            given.append(step if kind == "delta" else seen[-1][:2] + step)
            place = place + step if kind == "delta" else given[-1]
        states.append(np.array(seen)), actions.append(np.array(given))
    data, task = make_demonstrations(states, actions, control_hz=30, robot=[0, 1], action_kind=kind)
    assert frames_late(data, task) == 0


@pytest.mark.parametrize("kind", ["velocity", "absolute"])
@pytest.mark.parametrize("rate", [10.0, 20.0, 24.0])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_labels_that_were_resampled_are_on_time(rate, kind):
    """A held label does not tell of the commands between two new frames; the next one does."""
    states, actions = unsteady(lag=0.0, labelled=6, kind="delta" if kind == "velocity" else kind)
    held = resampled(make_recordings(states, actions, control_hz=30.0), rate, kind)
    data, task = make_demonstrations(held.states, held.actions, control_hz=rate, action_kind=kind)
    assert frames_late(data, task) == 0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_paths_without_anything_unforeseen_say_nothing():
    time, states, actions = np.linspace(0, 1, 101)[:, None], [], []
    for seed in range(30, 33):
        generator = np.random.default_rng(seed)
        path = generator.normal(0, 0.1, 3) + generator.uniform(-0.5, 0.5, 3) * time**3 * (10 - 15 * time + 6 * time**2)
        path += 0.1 * np.sin(np.pi * time) * generator.normal(size=3)
        states.append(path[:-1])
        actions.append(path[1:] + 0.02 * np.diff(path, axis=0))
    assert frames_late(*make_demonstrations(states, actions, control_hz=30, action_kind="absolute")) == 0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_differences_of_smooth_paths_are_on_time_beside_a_quaternion_of_another_sign():
    """A fit of many inputs extrapolates badly to the recording with the other sign; more labels seem to help."""
    time, states, actions = np.linspace(0, 1, 60)[:, None], [], []
    for number in range(8):
        generator = np.random.default_rng(number)
        start, goal = 0.3 * generator.normal(size=3), generator.normal(size=3)
        path = start + (goal - start) * (3 * time**2 - 2 * time**3)
        path += 0.2 * generator.normal(size=3) * np.sin(np.pi * time)
        half, sign = 0.5 * np.sin(2 * time + number) + 1.2, -1 if number == 3 else 1
        states.append(np.c_[path, 0 * half, 0 * half, sign * np.sin(half), sign * np.cos(half)])
        actions.append(np.diff(path, axis=0) if number < 5 else None)
    assert frames_late(*make_demonstrations(states, actions, control_hz=30)) == 0


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_few_or_constant_labels_say_nothing():
    data, task = recordings(2)
    for number in (16, 0):
        data["has_action"][number:] = False
        assert frames_late(data, task) == 0
    data, task = recordings(labelled=1)
    data["has_action"][42:] = False  # 36 rows for 33 inputs, which fit anything
    for seed in range(12):
        data["action"] = torch.randn(data["action"].shape, generator=torch.Generator().manual_seed(seed)).double()
        assert frames_late(data, task) == 0
    data, task = recordings(2)
    data["action"] = torch.ones_like(data["action"])
    assert frames_late(data, task) == 0


def test_the_warning_says_by_how_many_frames():
    with pytest.warns(UserWarning, match="actions look 2 frames late.* 2 frames earlier and leave the last ones empty"):
        recordings(2)


@pytest.mark.parametrize(("joints", "noise", "gain"), [(6, 1e-4, 0.7), (14, 1e-5, 1.0)])
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_smooth_targets_of_a_script_are_on_time(joints, noise, gain):
    """Collinear inputs need a small penalty: with a large one, later labels lowered the error of the fit."""
    generator, states, actions, time = np.random.default_rng(0), [], [], np.arange(304) / 30
    for _ in range(6):
        start, end = generator.uniform(-1, 1, (2, joints))
        share = np.clip(time / time[299], 0, 1)[:, None]
        wave = 0.05 * np.sin(2 * np.pi * time[:, None] * generator.uniform(0.1, 0.5, joints))
        target = start + (end - start) * (3 * share**2 - 2 * share**3) + wave
        place = [target[0]]
        for command in target[1:]:
            place.append(place[-1] + gain * (command - place[-1]))
        states.append((np.array(place) + generator.normal(0, noise, target.shape))[:300])
        actions.append(target[1:301])
    assert frames_late(*make_demonstrations(states, actions, control_hz=30, action_kind="absolute")) == 0
