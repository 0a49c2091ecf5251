# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests named columns as recordings: columns that are not states, ends of episodes, the rate by time stamps."""

from dataclasses import replace

import numpy as np
import pytest

from torchrl_koap.data import read_recordings
from torchrl_koap.data.formats.columns import assemble
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.pieces import Piece
from torchrl_koap.files import DataError

X = np.random.default_rng(0).normal(size=6).cumsum()
ENDS = np.array([0, 0, 1, 0, 0, 1])


def read(actions=None, control_hz=20.0, **columns):
    states = {"x": X[: len(next(iter(columns.values()), X))]} | {name: np.asarray(v) for name, v in columns.items()}
    return assemble([Piece("run", states, {"v": np.ones(len(states["x"]))})], "data", control_hz=control_hz)


@pytest.mark.parametrize("name", ["timeouts", "terminals", "done", "episode_ends"])
@pytest.mark.parametrize("kind", [int, float, bool])
def test_a_flag_ends_an_episode(name, kind):
    found = read(**{name: ENDS.astype(kind)})
    np.testing.assert_array_equal(np.stack(found.states)[..., 0], X.reshape(2, 3))
    assert found.skipped == (name,) and found.sources == ("run[0]", "run[1]")
    assert [len(frames) for frames in read(**{name: np.array([0, 0, 1, 1, 0, 0]).astype(kind)}).states] == [4, 2]


def test_a_counter_splits_and_sorts():
    assert [len(frames) for frames in read(frame_index=[0, 1, 2, 0, 1, 2]).states] == [3, 3]
    np.testing.assert_array_equal(read(frame_index=[2, 0, 1, 3, 5, 4]).states[0][:, 0], X[[1, 2, 0, 3, 5, 4]])
    mixed = read(traj_id=[0, 1, 0, 1, 0, 1], frame_index=[0, 0, 1, 1, 2, 2])
    np.testing.assert_array_equal(np.stack(mixed.states)[..., 0], [X[::2], X[1::2]])
    with pytest.raises(DataError, match="episode_id 0 returns"):
        read(episode_id=[0, 0, 1, 1, 0, 0])
    assert [len(frames) for frames in read(episode_id=[0, 0, 1, 1, 0, 0], time=np.arange(6) / 20).states] == [4, 2]
    rows = np.random.default_rng(1).permutation(30)
    few = read(episode=[0] * 6, x=[0, 1, 2, 3, 5, 4], time=np.array([0, 1, 2, 3, 5, 4]) / 20)
    np.testing.assert_array_equal(few.states[0][:, 0], np.arange(6))
    told = read(episode=[0] * 6, frame_index=[0, 1, 2, 3, 5, 4], time=np.arange(6) / 20)
    np.testing.assert_array_equal(told.states[0][:, 0], X[[0, 1, 2, 3, 5, 4]])  # the counter counts
    uneven = read(episode=[0] * 30, x=rows, time=(rows / 20) ** 2)
    np.testing.assert_array_equal(uneven.states[0][:, 0], np.arange(30))
    by_time = read(x=rows, time=rows / 20)
    np.testing.assert_array_equal(by_time.states[0][:, 0], np.arange(30))
    for numbers in ({}, {"episode": [0] * 6}):
        with pytest.raises(DataError, match="'frame_index' goes back from 2 to 1, not to its first number"):
            read(frame_index=[0, 1, 2, 1, 2, 3], **numbers)
        with pytest.raises(DataError, match="'frame_index' goes from 1 to 1: add the missing frames"):
            read(frame_index=[0, 1, 1, 2, 3, 4], **numbers)


@pytest.mark.parametrize("back", [1.03, 3600])
def test_a_clock_that_is_set_back_puts_no_rows_out_of_order(back):
    stamps, way = np.arange(60) / 20, np.random.default_rng(2).normal(size=60)
    late = {"x": way, "episode": np.zeros(60), "time": stamps - back * (stamps > 1.5)}
    np.testing.assert_array_equal(read(**late).states[0][:, 0], way)
    with pytest.raises(DataError, match="time stamps do not increase"):
        read(control_hz=None, **late)
    rows = np.random.default_rng(1).permutation(60)  # rows in any order, on a clock of seconds and nanoseconds
    ros = {"secs": stamps // 1, "nsecs": np.round(stamps % 1 * 1e9)}
    mixed = read(control_hz=None, **{name: values[rows] for name, values in ({**late} | ros).items() if name != "time"})
    np.testing.assert_array_equal(mixed.states[0][:, 0], way)


def test_all_columns_that_separate_episodes_are_used():
    both = read(session=[0, 0, 0, 0, 1, 1], trial=[0, 0, 1, 1, 0, 0])
    assert [frames[:, 0].tolist() for frames in both.states] == X.reshape(3, 2).tolist()
    assert [len(frames) for frames in read(session=[0, 0, 0, 0, 1, 1], done=[0, 1, 0, 1, 0, 1]).states] == [2, 2, 2]
    for counter in ([*range(3)] * 2, [5, 3, 4, 2, 0, 1]):  # begins again, or is out of order
        for numbers in ({}, {"episode": [0, 0, 0, 1, 1, 1] if counter[0] == 0 else [0] * 6}):
            found = read(frame_index=counter, done=np.isin(counter, [1, 3]), **numbers)
            assert [len(frames) for frames in found.states] == ([2, 2] if counter[0] == 0 else [2, 2, 2])
    with pytest.raises(DataError, match="trial 0 of session 0 returns"):
        read(trial=[0, 0, 1, 1, 0, 0], session=[0] * 6)


@pytest.mark.parametrize(
    "name", ["Timestamp", "time_s", "stamp", "Time [ms]", "__index_level_0__", "Unnamed: 0", "reward"]
)
def test_columns_that_are_not_states_are_dropped_and_listed(name):
    found = read(**{name: np.arange(6) * (50 if "ms" in name else 0.05)})
    assert found.state_names == ("x",) and found.skipped == (name,)


def test_a_column_that_rises_evenly_is_a_clock():
    found = read(x=np.random.default_rng(0).normal(size=30), ticks=np.arange(30) * 7.0)
    assert found.state_names == ("x",) and found.skipped == ("ticks (it rises evenly: a clock)",)
    ways = {"a": np.arange(30.0), "b": np.random.default_rng(1).normal(size=30)}
    pieces = [Piece(name, {"x": way, "y": way**2}, {"v": way}) for name, way in ways.items()]
    assert assemble(pieces, "data", control_hz=20).state_names == ("x", "y")  # in one file it is the motion


def test_columns_are_chosen_by_name():
    states = {"x": X, "time": X, "y": X}
    pieces = [Piece("run", states, {"v": X, "w": X})]
    found = assemble(pieces, "data", control_hz=5, state_columns=["time", "x"], drop_columns=["w"])
    assert (found.state_names, found.action_names, found.skipped) == (("time", "x"), ("v",), ("y", "w"))
    found = assemble(pieces, "data", control_hz=5, state_columns=["x", "y"], drop_columns=["y"])
    assert found.state_names == ("x",)
    timed = {"time": np.tile(np.arange(3) / 50, 2), "trial": np.arange(6) // 3}
    found = assemble([Piece("run", states | timed, {"v": X})], "data", state_columns=["x"])
    assert found.control_hz == pytest.approx(50) and len(found.states) == 2  # by columns that are no state
    with pytest.raises(DataError, match=r"unknown column in drop_columns \(--drop-columns\): 'yy'; did you mean 'y'"):
        assemble(pieces, "data", control_hz=5, drop_columns=["yy"])


def test_the_rate_is_read_in_its_unit_and_compared():
    assert read(control_hz=None, time_ms=np.arange(6) * 20.0).control_hz == pytest.approx(50)
    assert assemble([Piece("run", {"x": X}, {"v": X})], "data", declared_hz=20, control_hz=5).control_hz == 5
    with pytest.raises(DataError, match="gives 50 frames per second, the source declares 20"):
        assemble([Piece("run", {"x": X, "timestamp": np.arange(6) / 50}, {"v": X})], "data", declared_hz=20)


@pytest.mark.parametrize(("separator", "point"), [(",", "."), (";", "."), ("\t", "."), (";", ",")])
def test_separators_blank_lines_truth_values_and_text(separator, point, tmp_path):
    rows = [["time", "x", "touch", "phase", "action"], ["0", "0.5", "True", "reach", "1"]]
    rows += [["0.1", "0.7", "False", "grasp", "2"]]
    text = "\n".join(separator.join(row).replace(".", point) for row in rows)
    (tmp_path / "a.csv").write_text(text + "\n\n")
    found = read_recordings(tmp_path)
    assert found.control_hz == pytest.approx(10) and found.states[0].tolist() == [[0.5, 1], [0.7, 0]]
    assert found.skipped == ("phase (no numbers)", "time") and found.actions[0].tolist() == [[1]]


def test_the_same_fault_of_many_files_is_said_once(tmp_path):
    for number in range(9):
        (tmp_path / f"{number}.csv").write_text("time x\n0 1\n1 2\n")
    with pytest.raises(DataError, match=r"4.csv and 4 more: no column holds numbers: time x \(fields lie between"):
        read_recordings(tmp_path)
    for number in range(9):
        (tmp_path / f"{number}.csv").write_text("time,x,action\n0,1,on\n1,2,off\n")
    with pytest.raises(DataError, match="column 'action' is an action and holds no numbers"):
        read_recordings(tmp_path)


def test_archives_of_truth_values_and_of_lists(tmp_path):
    np.savez(tmp_path / "a.npz", states=X[:, None] > 0, actions=X[:, None], control_hz=20.0)
    assert set(np.unique(read_recordings(tmp_path).states)) <= {0.0, 1.0}
    np.savez(tmp_path / "a.npz", states=np.array([[1], [2, 3]], dtype=object))
    with pytest.raises(DataError, match="entry 'states' cannot be read: it holds objects"):
        read_recordings(tmp_path)


def test_the_order_of_columns_does_not_count_but_their_names_do():
    pieces = [Piece("a", {"x": X, "y": 2 * X}), Piece("b", {"y": 2 * X, "x": X})]
    found = assemble(pieces, "data", control_hz=20, action_dim=1)
    np.testing.assert_array_equal(*found.states)
    pieces += [Piece(name, {"x": X, "Y": X}) for name in "cd"]
    with pytest.raises(DataError, match="c, d: its state columns are not those of a: it lacks y and has Y besides"):
        assemble(pieces, "data", control_hz=20, action_dim=1)
    told = [replace(piece, actions={"v": X}) for piece in pieces]
    with pytest.raises(DataError, match="Y besides; name columns alike in all files, or drop those that some lack"):
        assemble(told, "data", control_hz=20)
    chosen = {"drop_columns": ["y", "Y"]}, {"state_columns": ["x"]}
    assert all(assemble(pieces, "data", control_hz=20, action_dim=1, **only).state_names == ("x",) for only in chosen)


def test_columns_that_split_episodes_can_be_dropped():
    assert len(read(timeouts=ENDS).states) == 2
    pieces = [Piece("run", {"x": X, "timeouts": ENDS, "frame_index": np.array([0, 1, 1, 2, 2, 9])}, {"v": X})]
    assert len(assemble(pieces, "data", control_hz=20, drop_columns=["timeouts", "frame_index"]).states) == 1


def test_lost_frames_and_rows_without_episode_are_told():
    with pytest.raises(DataError, match="run: column 'frame_index' goes from 2 to 5: add the missing frames"):
        read(frame_index=[0, 1, 2, 5, 6, 7])
    assert read(frame_index=[0, 5, 10, 15, 20, 25]).control_hz == 20
    with pytest.raises(DataError, match="column 'traj_id' is empty in row 2"):
        read(traj_id=[0, 0, np.nan, 1, 1, 1])


def test_all_clocks_are_looked_at():
    ticks = np.arange(6)
    found = read(control_hz=None, time=ticks / 20, ros_time=ticks / 4)
    assert found.control_hz == pytest.approx(20) and found.skipped == ("time", "ros_time (it says 4 frames per second)")
    parted = {"stamp.secs": 7 + ticks // 4, "stamp.nsecs": ticks % 4 * 0.25e9}  # ROS: seconds, and nanoseconds beside
    for ordered in (parted, dict(reversed(parted.items()))):
        found = read(control_hz=None, **ordered)
        assert found.control_hz == pytest.approx(4) and len(found.states) == 1


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("episode_ends", [2, 6]),
        ("episode_ends", [1, 5]),
        ("episode_ends", [0, 1, 0, 0, 0, 1]),
        ("episode_lengths", [2, 4]),
        ("episode_starts", [0, 2]),
    ],
)
def test_archives_say_where_episodes_end(name, values, tmp_path):
    np.savez(tmp_path / "a.npz", states=X[:, None], actions=X[:, None], control_hz=20.0, **{name: values})
    found = read_recordings(tmp_path)
    assert [frames[:, 0].tolist() for frames in found.states] == [X[:2].tolist(), X[2:].tolist()]
    np.savez(tmp_path / "a.npz", states=X[:, None], actions=X[:, None], control_hz=20.0, other=values)
    if len(values) == 2 and values[0]:  # anything may count from 0
        with pytest.raises(DataError, match="'other' may be the episode of each frame"):
            read_recordings(tmp_path)
        for options in ({"drop_columns": ["other"]}, {"state_columns": ["state_0"]}):
            assert read_recordings(tmp_path, **options).skipped == ("other",)


def test_a_clock_or_counter_that_starts_again_and_flags_of_starts():
    for column in ({"time": [0.0, 0.1, 0.2, 0, 0.1, 0.2]}, {"frame_index": [0, 1, 2] * 2}):
        for numbers in ({}, {"file": [7] * 6}):  # inside a number, too
            np.testing.assert_array_equal(np.stack(read(**column, **numbers).states)[..., 0], X.reshape(2, 3))
    for flags in ([1, 0, 0, 1, 0, 0], [1, 1, 0, 1, 1, 0], [0, 0, 0, 1, 1, 1]):  # a flag may stay 1
        assert [len(frames) for frames in read(is_first=flags).states] == [3, 3]
    for stamps in (
        [0.0, 0.1, 0.2, 0.3, 0.2, 0.3],
        [0.0, 0.1, 0.2, 0.15, 0.25, 0.35],
        [0.0, 0.1, 0.2, 0.0, 0.4, 0.5],
        [0.0, 0.1, 0.2, 0.3, 0.4, 0.0],
    ):
        with pytest.raises(DataError, match="time stamps do not increase"):  # set back or wrong, not started again
            read(control_hz=None, time=stamps)
        assert len(read(time=stamps, episode=[0] * 6).states) == 1


def test_a_camera_with_more_frames_than_rows_is_named():
    piece = Piece("run", {"x": X}, {"v": X}, cameras={"top": Clip("top.npy", tuple(range(7)))})
    with pytest.raises(DataError, match="run: camera 'top' has 7 frames for 6 rows: give their times in top_times.npy"):
        assemble([piece], "data", control_hz=20)


def test_several_episodes_need_an_action_for_every_frame():
    piece = Piece("run", {"x": X, "done": ENDS}, {"v": X[:5]})
    with pytest.raises(DataError, match="run: it holds 2 episodes and 5 actions for 6 frames: with several episodes"):
        assemble([piece], "data", control_hz=20)


def test_episodes_of_one_frame_are_left_out_and_listed():
    found = read(episode=[0, 1, 1, 1, 2, 2])
    assert [len(frames) for frames in found.states] == [3, 2] and found.skipped[0] == "run[0] (fewer than two frames)"
    with pytest.raises(DataError, match="none of its 6 trajectories has two frames"):
        read(episode=np.arange(6))
    for order in ("time", "frame_index", "episode", "done"):  # an empty file
        with pytest.raises(DataError, match="none of its 1 trajectories has two frames"):
            read(x=np.zeros(0), **{order: np.zeros(0)})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"0.1,0.2\n0.3,0.4\n", "its first row holds numbers, wanted the names of the columns"),
        ("x,y\n1,2\n3,4\n".encode("utf-16"), "it is no text in UTF-8: save it as CSV UTF-8"),
        (b"x,done\n1,no\n2,yes\n", "column 'done' is the end of episodes and holds no numbers"),
        (b"x,done\n1,0.5\n2,1\n", "column 'done' of the ends of episodes must be 0 or 1: rename it"),
    ],
)
def test_tables_that_cannot_be_understood(content, message, tmp_path):
    (tmp_path / "a.CSV").write_bytes(content)
    with pytest.raises(DataError, match=message):
        read_recordings(tmp_path, control_hz=20)


def test_trajectories_without_success_are_counted():
    found = read(success=[0, 0, 0, 0, 0, 1], episode=[0, 0, 0, 1, 1, 1])
    assert found.skipped == ("success (0 throughout 1 trajectories, which are kept)", "episode")
    assert read(success=[0, 0, 1, 0, 0, 1], episode=[0, 0, 0, 1, 1, 1]).skipped == ("success", "episode")


def test_resampling_leaves_out_lost_frames_of_recordings_without_actions():
    time = np.arange(40) / 30
    x = np.where(np.isin(np.arange(40), (7, 8, 20, 21, 22, 23)), np.nan, 2 * time)
    lost, whole = Piece("video", {"time": time, "x": x}), Piece("robot", {"time": time, "x": time}, {"v": time})
    options = {"resample": 20.0, "action_kind": "velocity"}
    found = assemble([whole, lost], "data", **options)
    assert found.sources == ("robot", "video[0]", "video[1]")  # two lost frames are filled, four split
    np.testing.assert_allclose(found.states[1][:, 0], 2 * np.arange(13) / 20)
    assert "6 frames with states that are NaN" in found.skipped
    lost_untimed, whole_untimed = Piece("video", {"x": x}), Piece("robot", {"x": time}, {"v": time})  # a rate alone
    for rate in ({"declared_hz": 30.0}, {"control_hz": 30.0}):
        same = assemble([whole_untimed, lost_untimed], "data", **options, **rate)
        assert same.sources == found.sources and "6 frames with states that are NaN" in same.skipped
    empty = replace(lost, actions={"v": np.full(40, np.nan)})  # a column that only holds labels in other files
    assert assemble([whole, empty], "data", **options).sources == found.sources
    for pieces, more in (([lost] * 7, {}), ([Piece("robot", lost.states, {"v": time})], options)):
        with pytest.raises(DataError, match="states are not finite, first at frame 7 in column 'x': fill") as error:
            assemble(pieces, "data", action_dim=1, **more)
        assert len(str(error.value)) < 300


def test_a_rate_against_the_stamps_is_warned_of():
    with pytest.warns(UserWarning, match=r"'time' \(it says 100 frames .* 20: if its stamps are right"):
        assert read(control_hz=20.0, time=np.arange(6) / 100).control_hz == 20
    gap = 1e4 * np.array([0, 1, 2, 3, 60, 61])
    with pytest.warns(UserWarning, match=r"'timestamp' \(its frames are 1 to 57 usual steps apart\) is overridden"):
        read(control_hz=100.0, timestamp=gap)
