# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the classification of columns by their name and content."""

import numpy as np
import pytest

from torchrl_koap.data.formats.kinds import as_numbers, is_action, kind_of, leaves, number_of


@pytest.mark.parametrize(
    ("kind", "names"),
    {
        "clock": "elapsed sim_time header.stamp wall_time stamp.nanosec timeStamp t_ms unix_ts utc robot_time_millis",
        "episode": "episodeId run trial_no traj-idx ep segment_id take trial-nr sequence_id video_name file",
        "end": "is_last truncated episode_ends episode_done traj_finished dones_float is_last_step eoe end_of_episode",
        "start": "is_first trajectory_starts new_episode is_reset start",
        "length": "lengths episode_length",
        "frame": "timestep stepIndex frame_number",
        "other": "discount cumulative_reward return_to_go next.success __index_level_0__ dt cost infos/x",
        None: "q s restart length return_spring left_arm_time_constant step_height q_s run_speed take_off info_x",
    }.items(),
)
def test_names_identify_columns_that_are_not_states(kind, names):
    assert {name: kind_of(name)[0] for name in names.split()} == dict.fromkeys(names.split(), kind)


def test_units_of_clocks():
    assert [kind_of(f"time_{unit}")[1] for unit in ("s", "msec", "us", "ns", "min")] == [1, 1e-3, 1e-6, 1e-9, 60]
    assert [kind_of(f"Time ({micro}s)") for micro in "\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"] == [("clock", 1e-6)] * 2


def test_names_with_spaces_and_points():
    assert kind_of("Trial Nr.")[0] == "episode" and kind_of("# timestamp")[0] == "clock"


def test_names_of_actions():
    known = ["action", "Action_0", "ACTION", "actions[1]", "action 2", "action0", "action.x", "actions-3", "action/x"]
    assert [is_action(name) for name in known] == [True] * len(known)
    assert not any(map(is_action, ("actionable", "reaction", "q_action", "act_0", "actuator")))


def test_texts_as_numbers():
    assert [number_of(text) for text in ("1e3", " -2 ", "TRUE", "false")] == [1000, -2, 1, 0]
    assert np.isnan([number_of(text) for text in ("", "NA", "n/a", "null", "None", "nan")]).all()
    assert {number_of(text) for text in ("1_000", "1\n5", "0x10", "3 rad", "left")} == {None}  # 1_000 is Python's alone


@pytest.mark.parametrize("zone", ["", "Z", "+02:00"])
def test_dates_of_a_clock_are_seconds(zone, recwarn):
    texts = np.array([f"2024-03-31 12:30:{second:04.1f}{zone}" for second in (0, 0.5, 1)])
    np.testing.assert_allclose(np.diff(as_numbers("time", texts)), 0.5)
    dates = np.array(["2024-03-31T12:30:00.0", "2024-03-31T12:30:00.5"], dtype="datetime64[us]")
    np.testing.assert_allclose(np.diff(as_numbers("time_ms", dates)), 500)
    assert as_numbers("x", dates) is None and as_numbers("time", np.array(["noon", "later"])) is None
    assert not recwarn


def test_numbers_of_episodes_that_float64_cannot_tell_apart():
    for first, kind in ((2**63, np.uint64), (-(2**63), np.int64)):
        for values in (np.array([first, first + 1], kind), np.array([f"{first}", f"{first + 1}"])):
            assert as_numbers("episode", values).tolist() == [0, 1]
    assert as_numbers("episode", np.zeros(0, int)).shape == (0,)


def test_nested_observations_are_in_the_order_of_their_names():
    assert [name for name, _ in leaves({"b": 1, "a": {"d": 2, "c": (3, 4)}})] == ["a_c_0", "a_c_1", "a_d", "b"]


def test_columns_of_any_type():
    for values in (
        np.array([b"1", b"0"]),
        np.array([True, False]),
        np.array([1, None], dtype=object),
        np.ones(2, "u1"),
    ):
        assert as_numbers("x", values)[0] == 1 and as_numbers("x", values).dtype == np.float64
    assert as_numbers("x", np.ones(2, complex)) is None and as_numbers("x", np.array(["1", "left"])) is None
    assert as_numbers("episode", np.array(["push", "reach", "push"])).tolist() == [0, 1, 0]
