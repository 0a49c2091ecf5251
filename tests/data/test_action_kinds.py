# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests warnings about actions of another kind than declared, and their absence for correct ones."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchrl_koap.data import make_demonstrations
from torchrl_koap.data.action_kinds import command_warnings, describe_likely, kind_warnings, likely_kinds

NOISE = np.random.default_rng(0).normal(size=(4, 60, 3))
PATHS = [noise.cumsum(0) for noise in NOISE]
DELTAS = [np.diff(path[:, :2], axis=0) for path in PATHS]
TARGETS = [path[1:, :2] + 0.1 * noise[1:, :2] for path, noise in zip(PATHS, NOISE[::-1], strict=True)]
NORMALISED = [np.tanh(0.2 * path[1:, :2] - 1) for path in PATHS]
JOINTS = ("shoulder.pos", "elbow pos", "cup")


def demonstrations(states, actions, names=JOINTS, acting=("a", "b"), **described):
    described |= {"state_names": names, "action_names": acting, "control_hz": 10}
    return make_demonstrations(states, actions, **described)


def warnings(*arguments, **described):
    return list(kind_warnings(*demonstrations(*arguments, **described), called="abcd"))


def test_targets_that_are_declared_as_changes():
    (said,) = warnings(PATHS, TARGETS)
    assert "of shoulder.pos, elbow pos on average: they look like absolute targets" in said
    assert said.endswith("again with --action-kind absolute --targets shoulder.pos 'elbow pos'")
    distance = float(said.split()[3])
    assert 0.05 < distance < 0.15
    assert not warnings(PATHS, TARGETS, action_kind="absolute", targets=JOINTS[:2])


def test_steps_without_a_label_say_nothing():
    data, task = demonstrations(PATHS, [TARGETS[0], None, None, None])
    (said,) = kind_warnings(data, task, "abcd")
    assert "of shoulder.pos, elbow pos on average: they look like absolute targets" in said


def test_far_numbers_are_compared_as_the_robot_reports_them():
    far = [path + 4e6 for path in PATHS]
    assert not warnings(far, [frames[1:, :2] for frames in far], action_kind="absolute", targets=JOINTS[:2])


def test_targets_are_named_behind_a_feature_of_other_width_than_its_columns():
    data, task = demonstrations(PATHS, TARGETS)
    turns = torch.tensor([1.0, 0, 0, 0]).expand(len(data), 4)
    for seen in (data, data["next"]):
        seen["observation"] = torch.cat([turns, seen["observation"]], 1)
    parts, state = {"turn": 4, "robot": JOINTS}, {"turn": "quaternion", "robot": "plain"}
    task = replace(task, observation_parts=parts, observation_units=(), state=state, robot=(2, 3, 4))
    (said,) = kind_warnings(data, task, "abcd")
    assert "of shoulder.pos, elbow pos on average: they look like absolute targets" in said
    assert [each.column for each in likely_kinds(data, task).values()] == [2, 3]


def test_a_name_that_is_the_same_allows_for_targets_that_lie_farther_away():
    paths = [path + 50 for path in PATHS]
    ahead = [frames[1:, :2] + 3 * noise[1:, :2] for frames, noise in zip(paths, NOISE[::-1], strict=True)]
    assert warnings(paths, ahead)[0].endswith("--action-kind raw")
    assert "absolute --targets" in warnings(paths, ahead, acting=JOINTS[:2])[0]


def test_one_absolute_column_beside_changes():
    mixed = [np.column_stack([steps[:, 0], aims[:, 1]]) for steps, aims in zip(DELTAS, TARGETS, strict=True)]
    assert warnings(PATHS, mixed)[0].endswith("--action-kind delta absolute --targets 'elbow pos'")
    assert not warnings(PATHS, mixed, action_kind=["delta", "absolute"], targets=JOINTS[1:2])


def test_a_gripper_of_two_values():
    """As a change it would widen the range in which all commands of its unit are kept."""
    opening = [np.column_stack([steps[:, 0], steps[:, 1] > 0]) for steps in DELTAS]
    (said,) = warnings(PATHS, opening, acting=("a", "grip"))
    assert said.startswith("grip: an action with two values") and said.endswith("--action-kind delta raw")
    assert not warnings(PATHS, opening, action_kind=["delta", "raw"])
    with pytest.raises(ValueError, match="unknown kind of action 'gripper'; known: delta"):
        demonstrations(PATHS, opening, action_kind=["delta", "gripper"])


def test_a_width_of_two_values_is_said_to_be_one_kind():
    closes = np.where(np.arange(60) < 30, 0.08, 0.02)  # in every recording: a target that is near its column
    paths = [np.column_stack([path[:, :1], np.roll(closes, 1), path[:, 2:]]) for path in PATHS]
    steps = [np.column_stack([np.diff(path[:, 0]), path[1:, 1]]) for path in paths]
    assert likely_kinds(*demonstrations(paths, steps))["b"].kind == "absolute"
    (said,) = warnings(paths, steps)
    assert said.startswith("b: an action with two values") and said.endswith("--action-kind delta raw")


def test_targets_and_a_gripper_get_one_remedy():
    steps = [np.column_stack([aims, aims[:, 0] > 0]) for aims in TARGETS]
    said = warnings(PATHS, steps, acting=("a", "b", "grip"))
    cure = "again with --action-kind absolute absolute raw --targets shoulder.pos 'elbow pos'"
    assert len(said) == 2 and all(each.endswith(cure) for each in said)


def test_quaternions_of_targets_are_one_target_whose_sign_is_that_of_the_state():
    def turned(half):
        return np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], 1)

    turns = [turned(path[:, 0] / 9) for path in PATHS]
    aims = [turn[1:] for turn in turns]
    described = {"names": [*"wxyz"], "acting": [f"to_{name}" for name in "wxyz"]}
    targets = {"action_kind": "absolute", "targets": [*"wxyz"]}
    assert warnings(turns, aims, **described)[0].endswith("again with --action-kind absolute --targets w x y z")
    assert not warnings(turns, aims, **described, **targets)
    (said,) = warnings(turns, [*aims[:3], -aims[3]], **described, **targets)
    assert said.startswith("actions to_w, to_x, to_y, to_z are a quaternion of the other sign than w, x, y, z in 59 of")
    others = likely_kinds(*demonstrations(turns, [turned(path[1:, 1] / 9) for path in PATHS], **described))
    assert "absolute" not in {each.kind for each in others.values()}


def test_the_nearest_quaternion_is_the_target_not_a_goal_where_the_robot_rests():
    reached = np.linspace(0, 3, 60).clip(0, 1)
    halves = [0.3 * number + reached for number in range(4)]
    turns = [np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], 1) for half in halves]
    states = [np.hstack([turn, turn[-1:].repeat(60, 0)]) for turn in turns]
    said = warnings(states, [turn[1:] for turn in turns], names=[*"wxyzWXYZ"], acting=[*"abcd"])
    assert said[0].endswith("again with --action-kind absolute --targets w x y z")


@pytest.mark.parametrize("scale", [1, 10], ids=["change", "velocity"])
def test_changes(scale):
    steps = [scale * step for step in DELTAS]
    assert not warnings(PATHS, steps)
    assert not warnings(PATHS, steps, acting=JOINTS[:2])
    (said,) = warnings(PATHS, steps, action_kind="absolute", targets=JOINTS[:2])
    assert said.endswith("convert again with --action-kind delta")


def test_velocities_that_are_also_in_the_state_are_no_targets():
    moving = [np.column_stack([path[1:, 0], 10 * step]) for path, step in zip(PATHS, DELTAS, strict=True)]
    steps = [frames[1:, 1:2] for frames in moving]
    assert not warnings(moving, steps, names=("q", "dq", "dp"), acting=("u",))


@pytest.mark.parametrize(
    ("actions", "kind", "said"),
    [
        (DELTAS, "delta", "near the change of a column"),
        (TARGETS, "absolute", "near a column"),
        (NORMALISED, "raw", "near neither"),
    ],
)
def test_the_likely_kind_comes_with_its_numbers(actions, kind, said):
    likely = likely_kinds(*demonstrations(PATHS, actions))
    assert {name: each.kind for name, each in likely.items()} == {"a": kind, "b": kind}
    column = np.corrcoef(np.concatenate(actions)[:, 0], np.concatenate([path[1:, 0] for path in PATHS]))[0, 1]
    if kind != "delta":
        assert likely["a"].follows_column == pytest.approx(column, abs=1e-5)
        assert likely["a"].follows_column > likely["a"].follows_change
    words = describe_likely(likely)
    assert words.startswith(f"{kind}: a, b ({said}; mean correlation ")
    assert f"{np.mean([each.follows_column for each in likely.values()]):.2f} with a column" in words


def test_an_action_that_never_changes_is_of_no_kind():
    steps = [np.column_stack([step[:, 0], np.ones(len(step))]) for step in DELTAS]
    assert list(likely_kinds(*demonstrations(PATHS, steps))) == ["a"]


def test_an_action_near_no_column_is_raw_if_others_are_targets():
    """Such as a thrust beside body rates: advice that leaves it a change is followed."""
    random = np.random.default_rng(0)
    steps = [np.column_stack([step[:, 0], random.normal(size=len(step))]) for step in TARGETS]
    (said,) = warnings(PATHS, steps)
    assert said.endswith("convert again with --action-kind absolute raw --targets shoulder.pos")
    assert not warnings(PATHS, steps, action_kind=["absolute", "raw"], targets=JOINTS[:1])


def test_normalised_targets_are_raw():
    (said,) = warnings(PATHS, NORMALISED)
    assert said.startswith("2 of 2 actions follow state columns rather than their changes (mean correlation 0.")
    assert said.endswith("convert again with --action-kind raw")
    assert not warnings(PATHS, NORMALISED, action_kind="raw")


def test_targets_in_other_units_than_their_columns_are_raw():
    degrees = [57.3 * steps for steps in TARGETS]
    (said,) = warnings(PATHS, degrees, action_kind="absolute", targets=JOINTS[:2])
    assert "from 'shoulder.pos', 'b' by" in said and said.endswith("convert again with --action-kind raw")
    offset = [steps + 90 for steps in TARGETS]
    assert not warnings(PATHS, offset, action_kind="absolute", targets=JOINTS[:2])


@pytest.mark.parametrize("change", [np.degrees, np.fliplr])
def test_targets_of_one_recording_in_another_unit_or_order(change):
    """They say nothing of the kind of all."""
    steps = [*TARGETS[:3], change(TARGETS[3])]
    (said,) = warnings(PATHS, steps, action_kind="absolute", targets=JOINTS[:2])
    assert said.startswith("absolute actions lie far from their targets in d, 'a' by ") and "'b' by" in said


def test_a_switch_beside_targets_is_raw_and_the_others_keep_theirs():
    paths = [40 * path + 90 for path in PATHS]
    steps = [np.stack([path[1:, 0], path[1:, 1] > 90], -1) for path in paths]
    (said,) = warnings(paths, steps, action_kind="absolute", targets=JOINTS[:2])
    assert said.endswith("convert again with --action-kind absolute raw --targets shoulder.pos")
    assert not warnings(paths, steps, action_kind=["absolute", "raw"], targets=JOINTS[:1])


def test_normalised_targets_of_columns_in_degrees_are_raw_however_they_are_declared():
    """They are small, so they lie nearer to the changes than to the columns."""
    paths = [40 * path + 90 for path in PATHS]
    steps = [path[1:, :2] / 400 for path in paths]
    (said,) = warnings(paths, steps, action_kind="absolute", targets=JOINTS[:2])
    assert said.endswith("convert again with --action-kind raw")
    assert [said[-3:] for said in warnings(paths, steps)] == ["raw"]
    assert not warnings(paths, steps, action_kind="raw")
    (said,) = warnings(PATHS, TARGETS, action_kind="absolute", targets=JOINTS[1::-1])
    assert said.endswith("--action-kind absolute --targets shoulder.pos 'elbow pos'")


def test_raw_actions_that_match_another_kind_are_named():
    assert warnings(PATHS, TARGETS, action_kind="raw")[0].endswith(
        "they look like absolute targets; convert again with --action-kind absolute --targets shoulder.pos 'elbow pos'"
    )
    (said,) = warnings(PATHS, DELTAS, action_kind="raw")
    assert said.startswith("actions follow changes of columns") and said.endswith("--action-kind delta")
    assert not warnings(PATHS, TARGETS, action_kind=["delta", "raw"])[1:]


def test_torques_follow_the_change_of_a_speed_and_are_no_changes():
    """With ``delta``, the decoder has no offset, so it cannot hold a joint against gravity."""
    speeds = [0.1 * path[:, :2] for path in PATHS]
    states = [np.hstack([speed.cumsum(0) / 10, speed]) for speed in speeds]
    torques = [
        6 * np.diff(speed, axis=0) + 0.5 * np.sin(frames[1:, :2]) for speed, frames in zip(speeds, states, strict=True)
    ]
    assert not warnings(states, torques, names=["q0", "q1", "v0", "v1"], action_kind="raw")


def test_targets_that_are_the_robots_columns_need_not_be_named():
    assert warnings(PATHS, TARGETS, robot=[0, 1])[0].endswith("convert again with --action-kind absolute")


def test_few_labels_give_no_warning_about_kinds():
    assert not warnings([PATHS[0][:10]], [TARGETS[0][:9]])
    assert not likely_kinds(*demonstrations([PATHS[0][:10]], [TARGETS[0][:9]]))


def test_a_column_that_repeats_the_last_action_is_named():
    """With it, recordings without actions would hold their actions."""
    pairs = zip(PATHS, DELTAS, strict=True)
    last = [np.column_stack([path[:, :2], np.vstack([[[0, 0]], steps])]) for path, steps in pairs]
    described = {"names": ("q", "r", "last a", "last b"), "robot": ["q", "r"]}
    (said,) = warnings(last, DELTAS, **described)
    assert said.startswith("columns last a, last b repeat the last action") and "--command" in said
    assert not warnings(last, DELTAS, command=["last a", "last b"], **described)
    switched = [np.column_stack([path, np.arange(60) > 30]) for path in PATHS]  # a gripper, measured and commanded
    steps = [np.column_stack([change, frames[1:, 3]]) for change, frames in zip(DELTAS, switched, strict=True)]
    assert not warnings(
        switched, steps, ("x", "y", "z", "open"), ("a", "b", "c"), action_kind=["delta", "delta", "raw"]
    )


def test_a_joystick_column_is_not_a_command():
    """It would be hidden from planner and controller."""
    sticks = [np.column_stack([path[:, :2], np.sin(0.3 * np.arange(len(path)))]) for path in PATHS]
    names = (*JOINTS[:2], "stick")
    (said,) = command_warnings(*demonstrations(sticks, DELTAS, names, robot=JOINTS[:2], command=["stick"]))
    assert said.startswith("command column 'stick' follows no action") and "--command" in said
    for actions in (DELTAS, [path[1:, :2] for path in PATHS]):  # changes of the command, and the command itself
        last = [np.column_stack([path[:, 2], path[:, :2]]) for path in PATHS]
        described = {"names": ("q", "a", "b"), "robot": ["q"], "command": ["a", "b"], "action_kind": "raw"}
        assert not list(command_warnings(*demonstrations(last, actions, **described)))
