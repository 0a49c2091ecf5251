# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests a user's own arrays as a data set that holds its whole task."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch

from torchrl_koap.data import (
    DataError,
    make_demonstrations,
    make_recordings,
    open_dataset,
    read_recordings,
    save_demonstrations,
    select_state,
)
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.ted import load_ted, read_about
from torchrl_koap.keys import validate
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.tasks import Action, Task
from torchrl_koap.training import TrainConfig
from torchrl_koap.training.closed_form import action_facts
from torchrl_koap.training.defaults import resolve
from torchrl_koap.training.policy_facts import command_ranges, commanded_columns, controller_data

RANDOM = np.random.default_rng(0)
STATES = [RANDOM.normal(size=(30, 4)).cumsum(0) for _ in range(3)]
ACTIONS = [np.diff(STATES[0][:, :2], axis=0), None, None]
NAMES = ["q1", "q2", "cup_x", "cup_y"]
ROBOT = ControllerConfig(columns="robot")


def test_labels_and_trajectories_that_are_left_out_are_told(tmp_path):
    states = [np.random.default_rng(seed).normal(size=(length, 2)) for seed, length in enumerate((60, 3, 60))]
    partly = np.diff(states[0], axis=0)
    partly[4:6, 0] = np.nan
    with pytest.warns(UserWarning, match="left out: actions of which only some columns are known .2 in trajectory 0"):
        make_demonstrations(states, [partly, None, None], control_hz=30)
    for make in (make_demonstrations, partial(save_demonstrations, tmp_path / "arm")):
        with pytest.warns(UserWarning, match="left out: 1 trajectories without two frames at 10 Hz: 1"):
            make(make_recordings(states, action_dim=1, control_hz=30), resample=10)


def test_a_folder_holds_data_and_task(tmp_path):
    folder = save_demonstrations(
        tmp_path / "my arm",
        STATES,
        ACTIONS,
        control_hz=20,
        state_names=NAMES,
        state_units=["rad", "rad", "m", "m"],
        action_names=["dq1", "dq2"],
        action_units="rad",
        robot=["q1", "q2"],
    )
    data, task = load_ted(folder / "ted")
    validate(data)
    assert data["has_action"].sum() == 29 and read_about(folder / "ted")["labelled_steps"] == 29
    assert task.name == "my_arm" and task.control_hz == 20 and task.max_steps == 45
    assert task.observation_names == tuple(NAMES) and task.observation_units == ("rad", "rad", "m", "m")
    assert task.actions == {"dq1": Action("rad"), "dq2": Action("rad")} and task.robot == (0, 1)
    assert task.observation_parts == {"robot": ("q1", "q2"), "surroundings": ("cup_x", "cup_y")}
    torch.testing.assert_close(data["observation"][:29], torch.from_numpy(STATES[0][:29]).float())


def test_commands_are_never_seen_by_what_learns():
    data, task = make_demonstrations(STATES, ACTIONS, control_hz=20, state_names=NAMES, command=["cup_x", "cup_y"])
    assert task.command == "command" and task.state_names == ("q1", "q2") and task.robot == (0, 1)
    assert task.state_of(data["observation"]).shape[-1] == 2
    _, task = make_demonstrations(STATES, ACTIONS, control_hz=20, command=[0, 1], robot=[3])
    assert task.robot == (1,)  # of the state, which lacks the commands


def test_columns_of_one_role_need_not_be_adjacent():
    _, task = make_demonstrations(STATES, ACTIONS, control_hz=20, robot=[0, 3])
    assert list(task.observation_parts) == ["robot", "surroundings", "robot_2"] and task.robot == (0, 3)


def test_absolute_actions_are_targets_of_columns():
    _, task = make_demonstrations(STATES, ACTIONS, control_hz=20, robot=["state_0", "state_1"], action_kind="absolute")
    assert task.targets == {0: 0, 1: 1}
    _, task = make_demonstrations(STATES, ACTIONS, control_hz=20, action_kind="absolute", targets=[1, 0])
    assert task.targets == {0: 1, 1: 0}
    _, task = make_demonstrations(STATES, ACTIONS, control_hz=20, action_kind="absolute", targets=[3, 1], command=[0])
    assert task.targets == {0: 2, 1: 0}  # of the state, which lacks the command


def test_every_action_may_be_of_its_own_kind():
    kinds = ("delta", "absolute")
    _, task = make_demonstrations(STATES, ACTIONS, control_hz=20, action_kind=kinds, targets=["state_3"])
    assert [action.kind for action in task.actions.values()] == list(kinds)
    assert task.delta_actions == (0,) and task.targets == {1: 3}
    with pytest.raises(DataError, match="absolute actions: 1, columns of the robot: 4.* without such a column"):
        make_demonstrations(STATES, ACTIONS, control_hz=20, action_kind=kinds)


def test_joint_targets_with_a_switch_are_learned_as_distances():
    """A hand that is told 0 or 1 must not make the joints be decoded as places."""
    steps, opens = ACTIONS[0][:, :1], STATES[0][1:, 2:3] > 0
    aims = [np.hstack([STATES[0][:-1, :1] + steps, opens]), None, None]
    options = {"action_kind": ("absolute", "raw"), "targets": [0], "robot": [0, 1], "control_hz": 20}
    data, task = make_demonstrations(STATES, aims, **options)
    data = select_state(data, task.state_of)
    view = controller_data(task, ROBOT, data)["action"][:29]
    torch.testing.assert_close(view, torch.from_numpy(np.hstack([steps, opens])).float(), atol=1e-5, rtol=0)
    torch.testing.assert_close(task.action_rule(data["state"][:29], view), data["action"][:29])


def test_raw_actions_refer_to_no_column():
    data, task = make_demonstrations(STATES, ACTIONS, control_hz=20, action_kind="raw", robot=[0, 1], command=[2, 3])
    assert {(action.kind, action.column) for action in task.actions.values()} == {("raw", None)}
    assert not task.targets and not task.delta_actions and task.action_rule is None
    assert action_facts(task, (0, 1)) == {"axes": [], "guessed": True, "alike": False}
    assert commanded_columns(task) is None
    for kinds in (["delta", "raw"], "absolute"):
        _, other = make_demonstrations(STATES, ACTIONS, control_hz=20, action_kind=kinds, robot=[0, 1])
        assert action_facts(other, (0, 1))["alike"]
    assert resolve(TrainConfig(out="run"), task).controller.preset == "absolute"  # centred, read off the present frame
    labels = data["action"][data["has_action"].squeeze(-1)]
    assert command_ranges(task, data) == [[float(x.min()), float(x.max())] for x in labels.T]


def test_a_controller_learns_the_distance_to_absolute_targets(tmp_path):
    """What it is shown, and what the policy adds again, are inverse to each other."""
    targets = [STATES[0][:-1, :2] + ACTIONS[0], None, None]
    names = {"state_names": NAMES, "robot": ["q1", "q2"]}
    folder = save_demonstrations(tmp_path / "reach", STATES, targets, control_hz=20, action_kind="absolute", **names)
    data, task = open_dataset(folder)
    view, known = controller_data(task, ROBOT, data), data["has_action"].squeeze(-1)
    torch.testing.assert_close(view["action"][known], torch.from_numpy(ACTIONS[0]).float(), atol=1e-5, rtol=0)
    assert view["action"][~known].isnan().all()
    again = task.action_rule(data["state"], view["action"])
    torch.testing.assert_close(again[known], data["action"][known], atol=1e-6, rtol=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"control_hz": None}, "control_hz .* is missing"),
        ({"command": ["q3"]}, "unknown column in command .*: 'q3'; did you mean 'q2'"),
        ({"command": [-1]}, r"command .*: there is no column -1, only 0..3"),
        ({"command": [9]}, r"command .*: there is no column 9, only 0..3"),
        ({"command": [0, 2]}, "command columns must be adjacent, got q1, cup_x"),
        ({"command": [0, 1, 2, 3]}, "every column is a command"),
        ({"command": [0], "robot": [0]}, "column 'q1' is both robot and command"),
        ({"robot": [0, 0]}, "robot .* holds q1 more than once"),
        (
            {"action_kind": "absolute"},
            r"actions: 2, columns of the robot: 4; name in targets \(--targets\) the col",
        ),
        ({"action_kind": "raw", "targets": [0, 1]}, "targets .* requires action_kind .* 'absolute'"),
        ({"action_kind": "absolute", "targets": [0, 3], "command": [3]}, "column 'cup_y' is both target and command"),
        ({"action_units": ["m"]}, "action_units .* names 1 columns, there are 2"),
        ({"state_units": ["m"]}, "state_units .* names 1 columns, there are 4"),
        ({"action_kind": ("delta",) * 3}, "action_kind .* names 3 columns, there are 2"),
        ({"action_kind": "absolut"}, "unknown kind of action 'absolut'; did you mean 'absolute'"),
        ({"robot": [True, False]}, r"robot \(--robot\) takes columns by name or number, got True"),
        ({"robot": []}, r"used: robot \(--robot\) names no column$"),
        ({"max_steps": 0}, r"max_steps \(--max-steps\) must be a positive whole number, got 0"),
        ({"max_steps": 9.5}, r"max_steps \(--max-steps\) must be a positive whole number, got 9.5"),
        ({"state_names": ["time", *NAMES[1:]]}, "state column 'time' is a clock, a counter or a flag by its name"),
    ],
)
def test_faults_of_the_description(options, message):
    with pytest.raises(ValueError, match=message):
        make_demonstrations(STATES, ACTIONS, **{"control_hz": 20, "state_names": NAMES} | options)


@pytest.mark.parametrize("given", [{"state_names": NAMES}, {"action_names": ["a", "b"]}, {"action_dim": 2}])
def test_recordings_keep_their_names(given):
    recordings = make_recordings(STATES, ACTIONS, control_hz=20)
    with pytest.raises(ValueError, match=f"recordings already hold their actions and names; {[*given][0]} must be Non"):
        make_demonstrations(recordings, **given)


def test_what_never_changes_within_a_recording_is_not_the_robot():
    with_goal = [np.insert(frames[:, :2], 2, goal, axis=1) for goal, frames in enumerate(STATES)]
    assert make_demonstrations(with_goal, ACTIONS, control_hz=20)[1].robot == (0, 1)
    assert make_demonstrations([np.zeros((20, 3))], control_hz=20, action_dim=2)[1].robot == (0, 1, 2)


def test_a_robot_that_stands_where_there_are_labels():
    still = [np.column_stack([0 * STATES[0][:, :2], STATES[0][:, 2:]]), *STATES[1:]]
    with pytest.raises(DataError, match="robot: q1, q2 never move in labelled trajectories"):
        make_demonstrations(still, ACTIONS, control_hz=20, state_names=NAMES, robot=["q1", "q2"])


@pytest.mark.parametrize("offset", [4e6, 1e8])
def test_an_offset_is_subtracted_in_float64_and_stored(offset, tmp_path):
    far = [frames + [offset, 0, 0, -offset] for frames in STATES]
    targets = [far[0][1:, [3, 0]], None, None]
    absolute = {"control_hz": 20, "action_kind": "absolute", "targets": [3, 0]}
    data, task = make_demonstrations(far, targets, **absolute)
    moved = [frames - task.observation_origin for frames in far]
    near, _ = make_demonstrations(moved, control_hz=20, action_dim=2)
    torch.testing.assert_close(data["observation"], near["observation"], atol=0, rtol=0)
    assert np.abs(np.array(task.observation_origin) - [offset, 0, 0, -offset]).max() < 20
    assert task.origins[1] == (task.observation_origin[3], task.observation_origin[0])
    torch.testing.assert_close(data["action"][:29], data["next", "observation"][:29, [3, 0]])
    assert Task.from_json(task.to_json()) == task
    again = read_recordings(save_demonstrations(tmp_path / "far", far, targets, **absolute))
    np.testing.assert_allclose(again.states[0], far[0], rtol=0, atol=1e-5)
    np.testing.assert_allclose(again.actions[0], targets[0], rtol=0, atol=1e-5)


def test_episodes_may_last_longer_than_the_longest_demonstration():
    assert make_demonstrations([STATES[0][:12], *STATES[1:]], action_dim=2, control_hz=20)[1].max_steps == 45


def test_small_offsets_stay():
    assert make_demonstrations([frames + 100 for frames in STATES], ACTIONS, control_hz=20)[1].origins is None


def test_offsets_that_cannot_be_subtracted():
    far = [frames + 1e8 for frames in STATES]
    with pytest.raises(DataError, match="command column 'cup_x' is at 1e.08: subtract this value"):
        make_demonstrations(far, ACTIONS, control_hz=20, state_names=NAMES, command=["cup_x"])
    with pytest.raises(DataError, match="action column 'action_1' is at 1e.08: subtract this value"):
        make_demonstrations(STATES, [ACTIONS[0] + [0, 1e8], None, None], control_hz=20)


@pytest.mark.parametrize("scale", [1e300, 1e40, 1e-300, 1e-42])
def test_numbers_that_float32_cannot_hold_raise_errors(scale, recwarn):
    with pytest.raises(DataError, match="state column 'q1' lies in .* too coarsely: change its unit"):
        make_demonstrations([frames * [scale, 1, 1, 1] for frames in STATES], ACTIONS, control_hz=20, state_names=NAMES)
    with pytest.raises(DataError, match="action column 'action_1' lies in .* too coarsely"):
        make_demonstrations(STATES, [ACTIONS[0] * [1, scale], None, None], control_hz=20)
    with pytest.raises(DataError, match="float64 resolves too coarsely"):
        make_demonstrations([frames + 1e16 for frames in STATES], ACTIONS, control_hz=20)
    assert not recwarn


def test_a_single_column_needs_no_list():
    assert make_demonstrations(STATES, ACTIONS, control_hz=20, state_names=NAMES, robot="q2")[1].robot == (1,)
    assert make_demonstrations(STATES, ACTIONS, control_hz=20, robot=1)[1].robot == (1,)


def test_what_is_unlikely_is_warned_of():
    targets = [STATES[0][1:, :2], None, None]
    with pytest.warns(UserWarning, match="they look like absolute targets"):
        make_demonstrations(STATES, targets, control_hz=20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_demonstrations(STATES, ACTIONS, control_hz=20)


def test_an_action_column_that_is_mostly_empty_is_named():
    sparse = ACTIONS[0].copy()
    sparse[np.arange(29) % 9 != 0, 1] = np.nan
    with pytest.raises(
        DataError, match=r"29 steps have actions, but action column 'action_1' \(known in 4\) is mostly"
    ):
        make_demonstrations(STATES, [sparse, None, None], control_hz=20)


def test_camera_frames_are_resampled_with_their_recordings(tmp_path):
    films = [Clip("top.npy", tuple(range(30)))] * 3
    recordings = make_recordings(STATES, action_dim=1, control_hz=20, sources=["a", "b", "c"], cameras={"top": films})
    found = read_recordings(save_demonstrations(tmp_path / "arm", recordings, resample=10))
    assert found.sources == ("a", "b", "c") and found.control_hz == 10
    assert [clip.numbers for clip in found.cameras["top"]] == [tuple(range(0, 30, 2))] * 3
    assert [len(frames) for frames in found.states] == [15] * 3


@pytest.mark.parametrize("rate", [0, -20, "20"])
def test_a_wrong_rate_is_named_before_recordings_are_resampled(rate):
    recordings = make_recordings(STATES, action_dim=1)
    with pytest.raises(DataError, match="control_hz .* must be a positive number of frames per second"):
        make_demonstrations(recordings, control_hz=rate, resample=10)


def test_nothing_is_written_if_anything_is_wrong(tmp_path):
    with pytest.raises(DataError):
        save_demonstrations(tmp_path / "arm", [*STATES, np.zeros((1, 4))], [*ACTIONS, None], control_hz=20)
    assert not list(tmp_path.iterdir())
