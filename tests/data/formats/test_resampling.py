# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests recordings at another rate: states between frames, and resampled actions."""

import numpy as np
import pytest

from torchrl_koap.data import make_demonstrations, make_recordings
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.resampling import leap_bounds, quaternion_starts, resampled
from torchrl_koap.files import DataError

TIME = np.arange(41) / 20


def recorded(*columns, actions=None, times=None, **more):
    frames = np.stack(columns, 1)
    steps = np.full((len(frames) - 1, 1), np.nan) if actions is None else actions
    return make_recordings([frames], [steps], control_hz=None if times is not None else 20.0, **more)


@pytest.mark.parametrize("rate", [5.0, 8.0, 20.0, 33.0, 40.0])
def test_states_are_interpolated(rate):
    found = resampled(recorded(3 * TIME, TIME > 1), rate)
    new = np.arange(int(2 * rate) + 1) / rate
    np.testing.assert_allclose(found.states[0][:, 0], 3 * new)
    assert set(found.states[0][:, 1]) == {0.0, 1.0} and found.control_hz == rate
    assert len(found.actions[0]) == len(found.states[0]) - 1


def test_a_clock_in_whole_milliseconds_keeps_the_last_frame():
    times = [np.round(np.arange(length) / 30, 3) for length in (74, 75, 76)]
    rows = make_recordings([np.arange(float(len(at)))[:, None] for at in times], action_dim=1)
    assert [len(frames) for frames in resampled(rows, 30.0, times=times).states] == [74, 75, 76]


def test_irregular_frames():
    times = np.sort(np.random.default_rng(0).uniform(0, 2, 80))
    times = times - times[0]
    actions = np.stack([np.diff(times**2), times[:-1]], 1)
    found = resampled(recorded(times**2, times=times, actions=actions), 10, ["change", "velocity"], times=[times])
    new = np.arange(len(found.states[0])) / 10
    np.testing.assert_allclose(found.states[0][:, 0], new**2, atol=5e-3)
    np.testing.assert_allclose(found.actions[0][:, 0], np.diff(found.states[0][:, 0]))
    assert (np.abs(found.actions[0][:, 1] - new[:-1]) < np.diff(times).max()).all()


def test_changes_are_summed_and_other_actions_are_held():
    kinds = ["change", "velocity", "absolute", "raw"]
    recordings = recorded(TIME, actions=np.stack([np.ones(40), *3 * [np.arange(40.0)]], 1), skipped=["a part"])
    half = resampled(recordings, 10, kinds)
    np.testing.assert_allclose(half.actions[0], np.stack([np.full(20, 2), *3 * [np.arange(0, 40, 2)]], 1))
    double = resampled(recordings, 40, kinds).actions[0]
    np.testing.assert_allclose(double, np.stack([np.full(80, 0.5), *3 * [np.arange(80) // 2]], 1))
    assert half.skipped == ("a part",)


@pytest.mark.parametrize(("kind", "known"), [("change", [True, False, True, True]), ("absolute", [True] * 4)])
def test_steps_with_an_unlabelled_part(kind, known):
    steps = np.ones((40, 1))
    steps[11] = np.nan  # in the second half of the second new step
    found = resampled(recorded(TIME, actions=steps), 2.5, kind)
    np.testing.assert_array_equal(np.isfinite(found.actions[0][:4, 0]), known)


def test_quaternions_keep_their_length_where_their_sign_changes():
    """The small column would be interpolated through zero, the large one would not."""
    half = 1.1 - TIME
    turn = np.stack([np.cos(half), np.sin(half), 0 * TIME, 0 * TIME]) * np.where(TIME < 1, 1, -1)
    (found,) = resampled(recorded(*turn, TIME), 33).states
    np.testing.assert_allclose(np.linalg.norm(found[:, :4], axis=1), 1, atol=1e-3)
    apart = np.abs(found[:, 0] * np.cos(1.1 - found[:, 4]) + found[:, 1] * np.sin(1.1 - found[:, 4]))
    assert apart.min() > np.cos(1 / 40)  # half a recorded step


def test_a_quaternion_has_norm_1_in_all_recordings():
    turn = np.eye(4)
    assert quaternion_starts([turn, turn]) == [0] and quaternion_starts([turn, 2 * turn]) == []


def test_a_leap_is_a_third_of_the_range_and_twenty_usual_steps():
    bounds, usual = leap_bounds([np.stack([TIME, 0 * TIME, np.where(TIME > 1, 9 + TIME, TIME)], 1)])
    np.testing.assert_allclose(bounds, [1.0, np.inf, 11 / 3])
    np.testing.assert_allclose(usual, [0.05, np.inf, 0.05])


def test_leaps_are_not_filled():
    angle = (3 * TIME + 1 + np.pi) % (2 * np.pi) - np.pi
    quaternion = np.cos(TIME) * np.where(TIME < 1, 1, -1)
    found = resampled(recorded(angle, quaternion), 13).states[0]
    new = np.arange(len(found)) / 13
    apart = np.abs(np.exp(1j * found[:, 0]) - np.exp(1j * (3 * new + 1)))
    assert apart.max() < 3 / 40 + 1e-9 and np.abs(found[:, 0]).max() <= np.pi  # half a recorded step
    np.testing.assert_allclose(np.abs(found[:, 1]), np.abs(np.cos(new)), atol=0.03)


def test_a_switch_is_that_of_the_nearest_frame():
    found = resampled(recorded(TIME > 0.01), 30).states[0][:, 0]
    np.testing.assert_array_equal(found, np.arange(61) > 0)  # 0.033 s is nearer to 0.05 s than to 0 s


@pytest.mark.parametrize("column", [7 * np.arange(41), TIME[:5]])
def test_many_whole_numbers_and_a_few_fractions_are_no_switches(column):
    found = resampled(recorded(column, np.zeros(len(column))), 40).states[0][:, 0]
    np.testing.assert_allclose(found[1::2], (column[1:] + column[:-1]) / 2)


def test_the_last_frame_is_kept_and_two_are_enough():
    """1.16 s last 29 steps of 0.04 s, although their quotient is rounded to less."""
    assert [len(resampled(recorded(TIME), rate).states[0]) for rate in (0.5, 1)] == [2, 3]
    assert len(resampled(make_recordings([TIME[:30, None]], action_dim=1, control_hz=25), 25).states[0]) == 30


def test_an_action_a_little_late_is_that_of_its_step():
    times = TIME + 0.004 * (np.arange(41) % 2)
    found = resampled(recorded(TIME, times=times, actions=np.arange(40.0)[:, None]), 20, "absolute", times=[times])
    np.testing.assert_array_equal(found.actions[0][:, 0], np.arange(40))


def test_one_lost_frame_with_clock_jitter_is_not_a_gap():
    times = np.delete(TIME, 20) + 0.01 * (np.arange(40) == 20)  # 0.11 s apart
    assert [len(resampled(recorded(times, times=times), rate, times=[times]).states) for rate in (20, 40)] == [1, 1]
    times = np.delete(TIME, [20, 21])
    assert len(resampled(recorded(times, times=times), 20, times=[times]).states) == 2


def test_a_gap_shorter_than_two_new_steps_is_none():
    times = TIME + 0.3 * (TIME > 0.98)
    assert len(resampled(recorded(TIME, times=times), 4, times=[times]).states) == 1
    assert len(resampled(recorded(TIME, times=times), 10, times=[times]).states) == 2


def test_cameras_show_the_nearest_frame_behind_a_gap_too():
    times = TIME + 3 * (TIME > 0.98)
    recordings = recorded(TIME, times=times, cameras={"top": [Clip("top.npy", tuple(range(100, 141)))]})
    before, behind = resampled(recordings, 10, times=[times]).cameras["top"]
    assert before.numbers == tuple(range(100, 120, 2)) and behind.numbers == tuple(range(120, 141, 2))
    before, _ = resampled(recordings, 30, times=[times]).cameras["top"]
    assert before.numbers[:7] == (100, 101, 101, 102, 103, 103, 104)


def test_gaps_end_trajectories_and_are_told():
    times = TIME + 3 * (TIME > 0.98) + 7 * (TIME > 1.93)
    found = resampled(recorded(TIME, times=times, actions=TIME[:-1, None]), 10, "velocity", times=[times])
    assert found.sources == ("0[0]", "0[1]") and [len(frames) for frames in found.states] == [10, 10]
    np.testing.assert_allclose(found.states[1][:, 0], 1 + np.arange(10) / 10)
    np.testing.assert_allclose(found.actions[1][:, 0], 1 + np.arange(9) / 10)
    assert found.skipped == (
        "2 gaps in time, where trajectories were split: 0 (3.05 s), 0 (7.05 s)",
        "1 trajectories without two frames at 10 Hz: 0[2]",
    )


@pytest.mark.parametrize(
    ("rate", "kind", "message"),
    [
        (41, "change", r"41 Hz is more than twice the rate of 0 \(20 Hz\): resample .* may be at most 40"),
        (0.4, "change", "no trajectory has two frames at 0.4 Hz"),
        (-1, "change", "must be a positive number of frames per second, got -1"),
        (10, "delta", "changes over one frame, .* pass action_kind .* 'change' or 'velocity', or 'raw' for torques"),
        (10, ["change"] * 2, "action_kind .* names 2 columns, there are 1"),
    ],
)
def test_what_cannot_be_done_is_refused(rate, kind, message):
    with pytest.raises(DataError, match=message):
        resampled(recorded(TIME, actions=TIME[:-1, None]), rate, kind)


def test_the_slowest_recording_limits_the_rate():
    recordings, times = make_recordings([TIME[:, None]] * 2, action_dim=1), [TIME, 2 * TIME]
    with pytest.raises(DataError, match=r"30 Hz is more than twice the rate of 1 \(10 Hz\): .* may be at most 20,"):
        resampled(recordings, 30, times=times)


def test_demonstrations_at_another_rate():
    states, steps = [np.stack([TIME, TIME], 1)] * 2, [np.ones((40, 1)), None]
    data, task = make_demonstrations(states, steps, control_hz=20, resample=10, action_kind="change")
    assert task.control_hz == 10 and task.max_steps == 32 and task.actions["action_0"].kind == "delta"
    assert data["action"][:20].unique().tolist() == [2.0] and int(data["has_action"].sum()) == 20
    with pytest.raises(DataError, match="the rate of the recordings is not known"):
        make_demonstrations(states, steps, resample=10, action_kind="change")
