# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests warnings about leaps, marks of missing values, other units and signs, each with its cause."""

import re

import numpy as np
import pytest

from torchrl_koap.data.odd_values import (
    leap_warnings,
    mark_warnings,
    quaternion_warnings,
    scale_warnings,
    spike_warnings,
    turn_warnings,
    unlabelled_warnings,
)

TIME = np.linspace(0, 2, 60)[:, None]


def seen(*trajectories):
    frames = [np.hstack([np.sin(TIME + index), columns]) for index, columns in enumerate(trajectories)]
    names = ["sine", *(f"q{index}" for index in range(trajectories[0].shape[1]))]
    return leap_warnings(frames, [f"trajectory {index}" for index in range(len(frames))], names)


def leaping(frames, at, change):
    frames = frames.copy()
    frames[at] = change(frames[at])
    return frames


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ((3 * TIME + 1 + np.pi) % (2 * np.pi) - np.pi, r"'q0' from 3.14 to -3.05 \(frame 22 of trajectory 0\): angles"),
        (np.hstack([np.pi - (4 * TIME) % (2 * np.pi), TIME / 9, 0.1 * TIME**2]), "'q0' .*: angles wrapped"),
        ((170 * TIME + 180) % 360 - 180, "angles wrapped by 360"),
        ((900 * TIME + 2600) % 4096, "a counter or an angle wrapped by 4.0.e.03"),
        (np.hstack([np.cos(TIME), np.sin(TIME)]) * np.where(TIME < 1, 1, -1), "'q0' .*, 'q1' .*: a quaternion"),
        (
            leaping(TIME + 3, 17, lambda value: 0 * value),
            "from 3.54 to 0 .*and 1 times more.*: a measurement that failed",
        ),
        (leaping(TIME, slice(40, None), lambda value: value + 9), "'q0' .*: a switch, or a measurement that failed"),
        (leaping(np.hstack([TIME, TIME**2]), slice(40, None), lambda value: value + 9), "two episodes in one"),
    ],
)
def test_leaps_are_named_with_their_cause(columns, message):
    (warning,) = seen(columns)
    assert re.search(message, warning)


def test_a_sudden_push_is_not_a_wrapped_counter():
    """Unwrapped by its height, all that follows would be wrong."""
    columns = 0.1 * np.sin(np.arange(600.0)[:, None] + np.arange(3))
    columns[300:303, 0] = [11, 10, 9]
    (warning,) = leap_warnings([columns], ["log"], ["gyro", "hip", "knee"])
    assert "a switch, or" in warning and "where the robot was reset, mark the end of an episode" in warning


def test_a_gripper_with_a_noisy_width_is_not_a_wrapped_counter():
    width = np.where(np.linspace(0, 1, 60) < 0.5, 0.08, 0.02)[:, None] + 1e-4 * np.sin(40 * TIME)
    (warning,) = seen(width)
    assert "a switch, or" in warning and "grippers and scans may leap" in warning


@pytest.mark.parametrize("axis", [(0.9, 0.43589, 0), (0, 0.6, 0.8)])
def test_a_rotation_vector_turns_over_at_pi(axis):
    vector = ((3 * TIME + np.pi) % (2 * np.pi) - np.pi) * np.array(axis)
    warnings = seen(np.hstack([TIME**2, vector, TIME**3]))
    assert warnings and all("a rotation vector, whose axis flips at pi" in warning for warning in warnings)


def test_many_columns_that_leap_are_counted():
    scan = np.hstack([TIME + 9 * (TIME > 0.3 + 0.035 * ray) for ray in range(36)])
    (warning,) = seen(scan)
    assert "'q4' from" in warning and "'q5'" not in warning
    assert " and 31 more: a switch" in warning and "grippers and scans may leap" in warning


def test_switches_and_smooth_columns_do_not_leap():
    assert seen(np.hstack([TIME > 1, np.exp(-3 * TIME), np.repeat([[0.0], [0.04], [0.08]], 20, 0)])) == []


def test_labels_that_leap():
    steps = 0.01 * np.sin(np.arange(1, 20)[:, None] / 4.5)
    steps[7] -= 2 * np.pi
    (warning,) = spike_warnings([steps], ["a.csv"], ["v"])
    assert warning.startswith("action 'v' is -6.27 in label 7 of a.csv and far from that in the labels before")
    assert list(spike_warnings([(np.arange(19) == 7).astype(float)[:, None]], ["a.csv"], ["v"])) == []  # a switch


def test_a_single_label_between_gaps_is_no_leap():
    steps = np.sin(np.arange(200)[:, None] / 11)
    steps[60:95] = steps[96:130] = np.nan
    assert list(spike_warnings([steps], ["a.csv"], ["v"])) == []
    steps[150] += 2 * np.pi
    (warning,) = spike_warnings([steps], ["a.csv"], ["v"])
    assert "in label 150 of a.csv" in warning


OFTEN = np.where(np.arange(60) % 3, 1, -1)[:, None]


@pytest.mark.parametrize("signs", [(OFTEN, OFTEN), (1, -1)], ids=["in most frames", "between trajectories"])
def test_signs_of_quaternions(signs):
    turn, names = np.hstack([np.cos(TIME / 4), np.sin(TIME / 4), 0 * TIME, 0 * TIME]), ["w", "x", "y", "z", "height"]
    trajectories = [np.hstack([turn * sign, TIME]) for sign in signs]
    (warning,) = quaternion_warnings(trajectories, names)
    assert warning.startswith("columns w, x, y, z are a quaternion that changes sign")
    assert not [*quaternion_warnings([np.hstack([turn, TIME])] * 2, names)]


def test_a_quaternion_that_leaps_in_one_column_is_no_wrapped_angle():
    turn = np.hstack([np.cos(TIME / 9), np.sin(TIME / 9), 0 * TIME, 0 * TIME]) * np.where(TIME < 1, 1, -1)
    assert seen(turn) == []
    (warning,) = quaternion_warnings([turn], ["w", "x", "y", "z"])
    assert "in 1 frames" in warning and warning.endswith("also on the robot")
    turn[9] = 0  # a measurement that failed does not hide what the columns are
    assert [warning] == [*quaternion_warnings([turn], ["w", "x", "y", "z"])]
    assert seen(turn)[0].endswith("a measurement that failed for a frame? fill it from its neighbours")


@pytest.mark.parametrize("turn", [2 * np.pi, 360])
def test_the_same_angle_a_turn_apart(turn):
    """A roll near pi that was unwrapped in each trajectory by itself; a wrist that winds has no gap."""
    roll = turn / 2 * (1 + 0.05 * np.sin(TIME))
    (warning,) = turn_warnings([roll, roll - turn, roll + 0.01], ["roll"])
    assert f"in 1 trajectories and about {turn:.3g} higher" in warning
    winding = [roll, roll - turn, roll - turn / 2]
    assert not [*turn_warnings([roll, roll + 0.01], ["roll"]), *turn_warnings(winding, ["roll"])]
    assert not [*turn_warnings([roll], ["roll"]), *turn_warnings([roll, roll + 3 * turn], ["roll"])]


@pytest.mark.parametrize(("kind", "mark"), [("column", -999), ("action", -999), ("column", 999)])
def test_marks_of_what_is_missing(kind, mark):
    rows = np.where(np.arange(60)[:, None] % 7, np.sin(TIME), mark)
    (warning,) = mark_warnings(rows, ["v"], kind)
    assert warning.startswith(f"{kind} 'v' is {mark} in 9 of 60 rows and within 0") and "missing values?" in warning
    for sound in (TIME > 1, np.round(TIME), np.minimum(TIME, 1), np.where(TIME > 1.97, 99, TIME)):
        assert not [*mark_warnings(sound.astype(float), ["v"], kind)]


def test_a_trajectory_in_another_unit():
    frames, called = [np.sin(TIME + index) for index in range(4)], ["a", "b", "c", "d"]
    assert not [*scale_warnings(frames, called, ["q"], "column")]
    frames[2] = np.degrees(frames[2])
    (warning,) = scale_warnings(frames, called, ["q"], "column")
    assert re.fullmatch("columns reach farther than usual, 'q' .* times, in c: another unit, or .*", warning)
    joints = [np.hstack([np.degrees(np.sin(TIME + index)) + 90, np.zeros_like(TIME)]) for index in range(4)]
    assert not [*scale_warnings(joints, called, ["q", "still"], "column")]
    joints[1] = np.radians(joints[1])
    (warning,) = scale_warnings(joints, called, ["q", "still"], "column")
    assert warning.startswith(
        "most columns move less than a twentieth as far as usual in b: another unit, or sensors that saw nothing?"
    )


@pytest.mark.parametrize("other", range(1, 10))
def test_recordings_of_two_laboratories_with_their_own_units(other):
    frames = [np.hstack([np.sin(TIME + index), np.cos(2 * TIME), TIME * (index % 3)]) for index in range(10)]
    called = [f"take {index}" for index in range(10)]
    assert not [*scale_warnings(frames, called, ["x", "y", "z"], "column")]
    degrees = [np.degrees(part) if index < other else part for index, part in enumerate(frames)]
    said = " ".join(scale_warnings(degrees, called, ["x", "y", "z"], "column"))
    assert "another unit" in said and ("take 0" if other <= 5 else "take 9") in said


@pytest.mark.parametrize(
    ("shift", "labelled", "told"), [(0.9, 4, False), (4.0, 4, True), (4.0, 10, False), (4.0, 1, False)]
)
def test_recordings_without_labels_that_lie_elsewhere(shift, labelled, told):
    frames = [np.hstack([np.sin(TIME + index) + shift * (index > 7), TIME]) for index in range(10)]
    called, known = [f"take {index}" for index in range(10)], [index < labelled for index in range(10)]
    found = list(unlabelled_warnings(frames, known, called, ["x", "y"]))
    where = "'x' lie far from all labelled trajectories in 2 of 6 without labels (take 8, take 9)"
    assert [where in said for said in found] == [True] * told


@pytest.mark.parametrize(
    ("share", "columns", "rests", "told"),
    [(0.01, 2, False, True), (0.0, 2, False, True), (0.01, 1, False, False), (0.01, 2, True, False)],
)
def test_recordings_without_labels_in_a_smaller_unit_or_with_sensors_off(share, columns, rests, told):
    """Pressures in bar instead of kPa, or an arm that was led by hand; other columns move as usual."""
    frames = [np.hstack([np.sin(TIME + index), np.cos(TIME), 100 * TIME, 90 * TIME]) for index in range(10)]
    for index in (8, 9, *([0] if rests else [])):  # what also rests with labels is a part that may rest
        frames[index][:, 4 - columns :] *= share
    called, known = [f"take {index}" for index in range(10)], [index < 4 for index in range(10)]
    found = list(unlabelled_warnings(frames, known, called, ["x", "y", "p", "q"]))
    where = "'p', 'q' move less than a tenth as far as in labelled trajectories in 2 of 6 without labels (take 8, take"
    assert [where in said for said in found] == [True] * told
    assert all(said.endswith("leave out these recordings, not columns") for said in found)


@pytest.mark.parametrize(("still", "told"), [(1, False), (2, True)])
def test_a_column_and_its_speed_that_rest_are_one(still, told):
    """Recordings without labels in which one axis, of which position and speed are recorded, was not needed."""
    bell = TIME**3 * (10 - 15 * TIME / 2 + 6 * TIME**2 / 4)
    paths = np.random.default_rng(0).uniform(1, 2, (10, 1, 3)) * bell
    paths[8:, :, :still] *= 0.01
    frames = [np.hstack([path, np.gradient(path, axis=0)]) for path in paths]
    called, known = [f"take {index}" for index in range(10)], [index < 4 for index in range(10)]
    assert bool(list(unlabelled_warnings(frames, known, called, [*"xyzuvw"]))) == told
