# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests warnings about valid but unlikely demonstrations; each names its trajectory."""

import numpy as np
import pytest
import torch

from torchrl_koap.data import DataError, flatten_trajectories, make_recordings
from torchrl_koap.data.quality import (
    constant_columns,
    drop_short,
    find_warnings,
    goal_columns,
    plan_coverage,
    still_ends,
    trim_still,
)
from torchrl_koap.tasks import Action, Task

PATH = torch.arange(40.0).reshape(20, 2)
ACTIONS = torch.ones(19, 1)
STEPS = torch.linspace(0, 1, 19)[:, None]
MOVED = torch.cat([torch.zeros(1, 1), STEPS]).cumsum(0)  # by these steps
MOVED = torch.cat([MOVED, torch.sin(MOVED)], 1)
TIME = np.linspace(0, 2, 60)[:, None]


def warnings(states, actions=None, *, columns=("x", "y"), units=("m", "m"), names=(), acting=("v",), robot=()):
    frames = [torch.as_tensor(path) for path in states]
    task = Task(
        name="arm",
        observation_parts={"arm": tuple(columns)},
        observation_units=tuple(units),
        actions={name: Action() for name in acting},
        position="arm",
        robot=robot,
    )
    data = flatten_trajectories(frames, actions, action_dim=len(acting), dtype=torch.float64)
    return find_warnings(data.set("state", data["observation"]), task, names)


def test_valid_demonstrations_give_no_warnings():
    assert warnings([MOVED, MOVED + 1, MOVED + 2], [STEPS, STEPS, 2 * STEPS]) == []


def test_each_warning_is_said_once_and_names_its_trajectory():
    names = [f"{letter}.pkl" for letter in "abcdef"]
    paths = [PATH, PATH, PATH * 0, PATH * 1e36, PATH + 1, PATH + 2]
    assert warnings(paths, [STEPS, STEPS, STEPS, STEPS, 0 * STEPS, None], names=names) == [
        "b.pkl repeats a.pkl: all states are equal; leave out the one with fewer labels",
        "c.pkl: nothing moves in its 19 steps",
        "d.pkl: x reaches 3.6e+37 m",
        "e.pkl: all 19 labelled actions are zero",
        "columns reach farther than usual, 'x' 2e+36 times, 'y' 2e+36 times, in d.pkl: another unit, or a"
        " measurement that failed?",
    ]


def test_columns_without_a_unit_are_not_looked_at():
    assert warnings([PATH * 1e6, PATH], units=["", ""]) == []
    assert len(warnings([PATH * 1e6, PATH], units=["", "rad"])) == 1


def test_a_last_frame_that_moves_is_a_movement_and_no_repetition():
    moved = PATH.clone()
    moved[-1] += 5
    at_last = torch.zeros(20, 2)
    at_last[-1] = 1
    assert not any("repeats" in said or "nothing moves" in said for said in warnings([PATH, moved, at_last]))


@pytest.mark.parametrize("little", [1, 2])
def test_a_fifth_of_the_columns_must_move_less_and_those_that_rest_do_not_count(little):
    sizes = torch.cat([torch.full((little,), 0.01), torch.ones(10 - little), torch.full((2,), 1e-7)])
    wave = torch.sin(PATH[:, :1] + torch.arange(12.0))
    said = warnings([wave * sizes, 2 * wave * sizes], columns="abcdefghijkl", units=())
    assert len(said) == little - 1 and all("'a', 'b' at most 0.0" in warning for warning in said)


@pytest.mark.parametrize(("units", "number"), [(("", ""), 1), (("px", ""), 0), (("px", "px"), 0)])
def test_columns_that_errors_hardly_show_need_units(units, number):
    said = warnings([MOVED * torch.tensor([1.0, 3000]), MOVED * torch.tensor([2.0, 2000])], units=units)
    assert len(said) == number
    for words in ("'y' moves ", "'x' at most ", "give state_units (--state-units)"):
        assert all(words in warning for warning in said)


def test_constant_and_duplicate_columns_are_named():
    states = [torch.cat([path, path[:, :1], torch.full((20, 1), 3.0)], -1) for path in (PATH, PATH + 1)]
    assert warnings(states, columns=["x", "y", "again", "shelf"], units=()) == [
        "columns 'x' and 'again' are the same in every step",
        "column 'shelf' is 3 in all 38 steps: it carries no information",
    ]


def test_noise_alone_is_named_whatever_the_units_of_others():
    """A frozen height in m beside an angle in degrees; a pose that differs between recordings is no noise."""
    noise = 1e-5 * np.random.default_rng(0).normal(size=(4, 60, 1))
    pulses = 1.0 * (np.random.default_rng(1).random((4, 60, 1)) < 0.1)
    paths = [np.hstack([60 * np.sin(TIME + i), 0.3 + noise[i], 0.1 * i - noise[i], pulses[i]]) for i in range(4)]
    said = warnings([*paths, paths[0][:3] + 1e-6], columns=["q", "z", "pose", "trigger"], units=())
    assert [each for each in said if "noise" in each] == [
        "columns 'z' show noise alone, no motion: they carry no information; leave them out"
    ]
    assert not any("noise" in each for each in warnings([path[:3] for path in paths], columns="qzpt", units=()))


def test_short_trajectories_are_named():
    (warning,) = warnings([PATH[:17], PATH[:6], PATH[:9]])
    assert "2 of 3 trajectories have fewer steps than a window of 16" in warning
    assert "trajectory 1 (5), trajectory 2 (8); remove them, in Python or with `koap convert --drop-short`" in warning


def test_actions_that_never_change_are_named():
    assert warnings([PATH], [torch.cat([PATH[1:, :1], ACTIONS], 1)], acting=["v", "grip"]) == [
        "action 'grip' is 1 in all labels: controllers command this value, method dp a value near it"
    ]
    assert constant_columns(np.array([[1.0, np.nan], [2.0, 5.0], [2.0, 5.0]])) == [2.0, 5.0]
    assert constant_columns(np.array([[3.0], [np.nan]])) == [None]  # a single label


def test_clocks_and_rates_are_told():
    wave = torch.sin(PATH[:, :1])
    (warning,) = warnings([torch.cat([wave + i, PATH[:, :1]], 1) for i in range(2)], columns=["q", "ticks"], units=())
    assert warning.startswith("column 'ticks' rises by nearly the same amount in every frame")
    data = flatten_trajectories([wave], None, action_dim=1)
    task = Task(name="arm", observation_parts={"q": 1}, actions={"v": Action()}, position="q", control_hz=0.03)
    assert "control_hz is 0.03: frames per second" in find_warnings(data.set("state", data["observation"]), task)[0]


def test_isolated_labels():
    alone = torch.where(torch.arange(19)[:, None] % 4 == 1, STEPS, torch.nan)
    single = torch.where(torch.arange(19)[:, None] == 5, STEPS, torch.nan)
    (warning,) = warnings([MOVED, MOVED + 1, MOVED + 2], [alone, STEPS, single])
    assert warning.startswith("most labels are isolated in 1 trajectories: trajectory 0 (5 of 19 steps)")


def test_odd_values_of_states_and_actions_are_warned_of():
    rows, wave = np.arange(60)[:, None], np.sin(4 * TIME)
    turned = np.hstack([np.cos(TIME), np.sin(TIME), 0 * TIME, 0 * TIME]) * np.where(rows % 3, 1, -1)
    columns = [wave, (3 * TIME + np.pi) % (2 * np.pi) - np.pi, np.where(rows % 9, wave, -9999), turned]
    labels = np.hstack([wave - 6.28 * (rows == 7), np.where(rows % 3, wave, -999)])[:59]
    said = "\n".join(warnings([np.hstack(columns)], [torch.tensor(labels)], columns="sqmwxyz", units=(), acting="vu"))
    for words in (
        "angles wrapped",
        "column 'm' is -9999",
        "w, x, y, z are a quaternion that changes sign",
    ):
        assert words in said
    assert "action 'v' is -5" in said and "action 'u' is -999" in said


def test_the_same_angle_a_turn_apart_is_warned_of():
    paths = [np.hstack([3 + np.sin(TIME) / 9 + turn, TIME]) for turn in (0, 2 * np.pi)]
    assert any("column 'roll' lies within" in said for said in warnings(paths, columns=("roll", "x"), units=()))


def test_columns_that_differ_between_trajectories_alone_are_goals():
    frames = [np.hstack([TIME + goal, 0 * TIME + goal, 0 * TIME]) for goal in (1, 2)]
    assert goal_columns(make_recordings(frames, action_dim=1, state_names=["x", "goal", "shelf"])) == ["goal"]


def test_goals_that_change_within_recordings_are_not_the_robot():
    """As in Minari's mazes, where first frames hold the goal of the recording before; grippers have few values."""
    paths = np.random.default_rng(0).normal(size=(6, 60, 1)).cumsum(1)
    rows = np.arange(60)[:, None]
    behind = rows > 0
    kinds = [
        (lambda i: np.where(behind, i + 1.5, i + 0.5), 1),
        (lambda i: 1.0 * (behind * i % 2), 0),
        (lambda i: (rows - 20).clip(0, 2) * (i + 1.0), 0),  # moves for two steps, as a joint does
        (lambda i: rows // 10 + 6.0 * i, 0),  # changes in one step of ten
    ]
    for goal, told in kinds:
        found = warnings([np.hstack([path, goal(i)]) for i, path in enumerate(paths)], robot=(0, 1))
        assert sum("the controller reads 'y', which keep" in each for each in found) == told


def test_a_plan_that_is_short_against_the_motion():
    data = flatten_trajectories([torch.zeros(1001, 2)] * 3, None, action_dim=1)
    covers, short = plan_coverage(data, 500.0)
    assert covers == "14 frames, 28 ms; demonstrations last 2 s (median)"
    assert "covers 14 frames, 28 ms, 1.4% of a demonstration" in short and "125 Hz (one frame in 4)" in short
    assert plan_coverage(data[:2000:4], 125.0)[1] is None


def test_a_gait_of_many_minutes_needs_no_other_rate():
    time = torch.arange(3001.0)[:, None]
    for period in (14, 25, 40):  # frames; a plan has 14
        gait = torch.sin(2 * torch.pi * (time / period + torch.rand(4)))
        assert plan_coverage(flatten_trajectories([gait] * 2, None, action_dim=1), 50.0)[1] is None
    for slow in (torch.sin(time / period + torch.rand(4)) for period in (16, 300)):
        assert plan_coverage(flatten_trajectories([slow] * 2, None, action_dim=1), 50.0)[1] is not None


def test_stillness_is_told():
    frames = [np.concatenate([np.zeros((40, 1)), TIME[:20]]) + index for index in range(2)]
    assert still_ends(frames).tolist() == [[40, 0], [40, 0]]
    (warning,) = warnings(frames, columns=["q"], units=())
    assert warning.startswith("nothing moves in 68% of all frames at the start and 0% at the end")


LINE = PATH.double().numpy()


def test_frames_and_actions_are_cut_together():
    frames = np.concatenate([LINE[:1].repeat(9, 0), LINE, LINE[-1:].repeat(4, 0)])
    found = trim_still(make_recordings([frames, LINE], [np.arange(33.0)[:, None], None], control_hz=20))
    np.testing.assert_array_equal(found.states, [LINE, LINE])
    np.testing.assert_array_equal(found.actions[0][:, 0], np.arange(9.0, 28))
    assert found.skipped == ("13 still frames of 1 trajectories",) and found.control_hz == 20
    uncut = trim_still(make_recordings([LINE], [LINE[1:]], control_hz=20))
    assert uncut.skipped == ("0 still frames of 0 trajectories",)


def test_a_slow_trajectory_is_not_cut_from_both_ends_at_once():
    slow = np.linspace(0, 0.0025, 50)[:, None] * (LINE.max() - LINE.min())  # barely more than what counts as still
    found = trim_still(make_recordings([np.repeat(slow, LINE.shape[1], 1), LINE], action_dim=1))
    assert [len(frames) for frames in found.states] == [50, len(LINE)]


def test_noise_of_sensors_is_no_movement():
    generator, ramp = np.random.default_rng(0), np.repeat(np.linspace(0, 1, 20)[:, None], 3, 1)
    frames = [np.concatenate([np.zeros((40, 3)), ramp]) + generator.normal(size=(60, 3)) / 100 for _ in range(6)]
    starts, ends = still_ends(frames).T
    assert (38 <= starts).all() and (starts <= 41).all() and (ends <= 2).all()
    assert (still_ends([*frames, frames[0][:2]])[:-1, 0] == starts).all()  # two frames show no noise
    walks = [generator.normal(size=(60, 3)).cumsum(0) for _ in range(6)]
    assert not still_ends(walks).any()


def test_short_trajectories_are_left_out_and_named():
    recordings = make_recordings([LINE[:16], LINE[:17], LINE], action_dim=1, sources=["a", "b", "c"])
    found = drop_short(recordings)
    assert found.sources == ("b", "c") and found.skipped == ("a (15 steps)",) and len(found.actions) == 2
    with pytest.raises(DataError, match="no trajectory has the 16 steps of a window"):
        drop_short(make_recordings([LINE[:9]], action_dim=1))


def test_recordings_of_one_name_that_repeat_are_found():
    assert any("take repeats take" in said for said in warnings([MOVED, MOVED], [None, STEPS], names=["take"] * 2))


def test_a_recording_with_labels_beside_itself_without_them():
    said = warnings([MOVED, MOVED], [None, STEPS], names=["run_5.csv", "run_5_labelled.csv"])
    wanted = "run_5_labelled.csv repeats run_5.csv: all states are equal; leave out the one with fewer labels"
    assert said == [wanted]


def test_a_random_walk_is_no_sensor_noise():
    walks = [np.random.default_rng(index).normal(size=(40, 2)).cumsum(0) for index in range(3)]
    assert not still_ends(walks).any()
