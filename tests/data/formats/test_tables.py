# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests folders of NumPy archives, CSV and parquet files."""

import warnings

import numpy as np
import pytest

from torchrl_koap.data.formats.tables import read_tables
from torchrl_koap.files import DataError

FRAMES = np.linspace(0, 1, 12).reshape(6, 2)


def write_csv(file, columns):
    header, rows = ",".join(columns), zip(*columns.values(), strict=True)
    file.write_text("\n".join([header, *(",".join("" if v is None else str(v) for v in row) for row in rows)]) + "\n")


def columns_of(rows=6, **more):
    time = [round(0.02 * row, 4) for row in range(rows)]
    columns = {"timestamp": time, "x": FRAMES[:rows, 0].tolist(), "y": FRAMES[:rows, 1].tolist()}
    return columns | more


def test_archives(tmp_path):
    np.savez(tmp_path / "a.npz", observation=FRAMES, action=np.ones((5, 3)), control_hz=25, state_names=["x", "y"])
    np.savez(tmp_path / "b.npz", observation=FRAMES[:4])
    recordings = read_tables(tmp_path)
    assert recordings.control_hz == 25 and recordings.state_names == ("x", "y")
    assert [len(frames) for frames in recordings.states] == [6, 4] and recordings.num_labels == 5
    assert recordings.sources == ("a.npz", "b.npz")


def test_archives_without_names_keep_the_names_of_other_entries(tmp_path):
    beside = {"time": np.arange(6) / 25, "timeouts": np.arange(6) == 2}
    np.savez(tmp_path / "a.npz", states=FRAMES, actions=np.ones((6, 1)), state_names=["x", "y"], **beside)
    np.savez(tmp_path / "b.npz", states=FRAMES, actions=np.ones((6, 1)), **dict(reversed(beside.items())))
    recordings = read_tables(tmp_path)
    assert recordings.state_names == ("x", "y") and recordings.control_hz == pytest.approx(25)
    assert recordings.sources == ("a.npz[0]", "a.npz[1]", "b.npz[0]", "b.npz[1]")
    np.testing.assert_array_equal(recordings.states[0], recordings.states[2])
    (tmp_path / "a.npz").rename(tmp_path / "c.npz")
    assert read_tables(tmp_path).state_names == ("x", "y")
    (tmp_path / "c.npz").rename(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", states=FRAMES[:, :1], actions=np.ones((6, 1)), speed=FRAMES[:, 1], **beside)
    with pytest.raises(DataError, match="its state columns are not those of a.npz"):
        read_tables(tmp_path)


def test_archives_that_declare_other_rates(tmp_path):
    for name, rate in (("a", 20), ("b", 20), ("c", 22)):
        np.savez(tmp_path / f"{name}.npz", states=np.repeat(FRAMES**2, 5, 0), actions=np.ones((30, 1)), control_hz=rate)
    assert read_tables(tmp_path).control_hz == 20
    np.savez(tmp_path / "c.npz", states=np.repeat(FRAMES**2, 5, 0), control_hz=30)
    with pytest.raises(DataError, match="the files have 20 to 30 frames per second: pass resample"):
        read_tables(tmp_path)
    assert read_tables(tmp_path, control_hz=25).control_hz == 25
    held = {"resample": 10.0, "action_kind": "velocity"}
    assert [len(frames) for frames in read_tables(tmp_path, **held).states] == [15, 15, 10]
    np.savez(tmp_path / "b.npz", states=FRAMES**2)  # as fast as which?
    with pytest.raises(DataError, match="the files have 20 to 30 frames per second"):
        read_tables(tmp_path, **held)
    np.savez(tmp_path / "b.npz", states=FRAMES, control_hz=0)
    with pytest.raises(DataError, match="b.npz: entry 'control_hz' must be one positive number"):
        read_tables(tmp_path)


@pytest.mark.parametrize(
    ("name", "values"),
    [("ends", [4, 2, 6]), ("ends", [2, 4]), ("lengths", [2, 3]), ("lengths", [0, 6])]
    + [("starts", [1, 3]), ("starts", [0, 4, 2])],
)
def test_borders_of_episodes_that_do_not_fit_are_refused(name, values, tmp_path):
    np.savez(tmp_path / "a.npz", states=FRAMES, actions=np.ones((6, 1)), control_hz=9, **{f"episode_{name}": values})
    with pytest.raises(DataError, match=f"entry 'episode_{name}' must have one number for each of 6 frames, or the"):
        read_tables(tmp_path)


def test_an_entry_does_not_replace_a_state_column_of_its_name(tmp_path):
    np.savez(tmp_path / "a.npz", states=FRAMES, state_names=["x", "y"], x=np.arange(6.0) ** 2)
    with pytest.raises(DataError, match="a.npz: two entries have a column x: rename one of them"):
        read_tables(tmp_path, control_hz=25, action_dim=1, state_columns=["x"])


def test_csv_with_gaps_in_its_labels(tmp_path):
    write_csv(tmp_path / "run.csv", columns_of(action_vx=[0.5, None, 0.25, 0.5, 1.0, 9.0]))
    recordings = read_tables(tmp_path)
    assert recordings.control_hz == pytest.approx(50)
    assert recordings.state_names == ("x", "y") and recordings.action_names == ("action_vx",)
    np.testing.assert_array_equal(recordings.actions[0][:, 0], [0.5, np.nan, 0.25, 0.5, 1.0])
    np.testing.assert_allclose(recordings.states[0], FRAMES)


def test_a_row_of_empty_fields_between_others_is_a_lost_frame(tmp_path):
    (tmp_path / "run.csv").write_text(",\nx,y\n1,2\n\n3,4\n,\n5,6\n,\n,\n")
    with pytest.raises(DataError, match="states are not finite, first at frame 2 in column 'x'"):
        read_tables(tmp_path, control_hz=10, action_dim=1)
    (tmp_path / "run.csv").write_text(",\nx,y\n1,2\n\n3,4\n,\n,\n")
    assert read_tables(tmp_path, control_hz=10, action_dim=1).states[0].tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize("parted", ["1,000", "1.000"])
def test_thousands_with_a_separator_are_refused(parted, tmp_path):
    """With semicolons, a comma is a decimal one: 1,000 behind 999 would be 1."""
    (tmp_path / "run.csv").write_text(f"x;y\n998;1\n999;2\n{parted};3\n")
    with pytest.raises(DataError, match="run.csv: column 'x' holds 1,000, which may be 1000 or 1: write thousands"):
        read_tables(tmp_path, control_hz=10, action_dim=1)
    (tmp_path / "run.csv").write_text(f"x;y\n98;1\n0,999;2\n{parted};3\n")
    assert read_tables(tmp_path, control_hz=10, action_dim=1).states[0][:, 0].tolist() == [98, 0.999, 1]


def test_rows_that_begin_like_comments_are_listed(tmp_path):
    (tmp_path / "run.csv").write_text("# an arm\nrun,x\n#1,2\n#1,3\na,4\na,5\n")
    recordings = read_tables(tmp_path, control_hz=10, action_dim=1)
    assert recordings.states[0].tolist() == [[4], [5]] and "2 rows of run.csv that begin with #" in recordings.skipped


def test_only_the_first_name_loses_the_mark_of_comments(tmp_path):
    (tmp_path / "run.csv").write_text("# t,x,joint #,#\n0,1,2,3\n1,4,5,6\n")
    found = read_tables(tmp_path, action_dim=1)
    assert found.state_names == ("x", "joint #", "#") and found.states[0].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_named_action_columns_and_episodes(tmp_path):
    columns = columns_of(vx=[1.0] * 6, episode=[0, 0, 0, 1, 1, 1])
    columns["timestamp"] = [0.0, 0.1, 0.2] * 2
    write_csv(tmp_path / "run.csv", columns)
    recordings = read_tables(tmp_path, action_columns=["vx"])
    assert recordings.control_hz == pytest.approx(10) and recordings.sources == ("run.csv[0]", "run.csv[1]")
    assert [steps.shape for steps in recordings.actions] == [(2, 1), (2, 1)]


def test_files_without_the_action_columns_have_no_actions(tmp_path):
    write_csv(tmp_path / "a.csv", columns_of())
    write_csv(tmp_path / "b.csv", columns_of(motor_1=[1.0] * 6, motor_2=[2.0] * 6))
    motors = ["motor_1", "motor_2"]
    recordings = read_tables(tmp_path, action_columns=motors)
    assert recordings.state_names == ("x", "y") and recordings.action_names == ("motor_1", "motor_2")
    assert recordings.num_labels == 5 and np.isnan(recordings.actions[0]).all()
    with pytest.raises(
        DataError, match=r"b.csv: .* has motor_1, motor_2 besides; name the action columns of tables in action_co"
    ):
        read_tables(tmp_path)
    with pytest.raises(DataError, match="'motor_3'; did you mean 'motor_2'"):
        read_tables(tmp_path, action_columns=[*motors, "motor_3"])
    write_csv(tmp_path / "c.csv", columns_of(motor_1=[1.0] * 6))
    with pytest.raises(DataError, match=r": c.csv: lacks motor_2 of action_columns \(--action-columns\)$"):
        read_tables(tmp_path, action_columns=motors)


def test_archives_have_no_columns_to_name(tmp_path):
    np.savez(tmp_path / "a.npz", states=np.zeros((5, 2)), actions=np.ones((4, 1)), control_hz=30.0)
    with pytest.raises(
        ValueError, match=r"action_columns .--action-columns.: not an option for NumPy archives \(a.npz\)"
    ):
        read_tables(tmp_path, action_columns=["action_0"])


def test_parquet_is_read_as_csv_is(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra 'lerobot')")
    parquet = pytest.importorskip("pyarrow.parquet")

    actions = [[0.1, 0.2]] * 5 + [None]
    table = pyarrow.table(columns_of(action=actions, frame_index=list(range(6))))
    parquet.write_table(table, tmp_path / "run.parquet")
    recordings = read_tables(tmp_path)
    assert recordings.action_names == ("action_0", "action_1") and recordings.state_names == ("x", "y")
    assert recordings.num_labels == 5
    np.testing.assert_allclose(recordings.states[0], FRAMES)


@pytest.mark.parametrize("kind", ["null", "list"])
def test_a_column_of_empty_lists_holds_no_actions(kind, tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra 'lerobot')")
    parquet = pytest.importorskip("pyarrow.parquet")
    empty = pyarrow.nulls(6, pyarrow.null() if kind == "null" else pyarrow.list_(pyarrow.float32()))
    for name, actions in (("a", [[0.1, 0.2]] * 6), ("b", empty)):
        parquet.write_table(pyarrow.table(columns_of(action=actions)), tmp_path / f"{name}.parquet")
    found = read_tables(tmp_path, control_hz=10)
    assert found.num_labels == 5 and np.isnan(found.actions[1]).all() and found.action_names == ("action_0", "action_1")


@pytest.mark.parametrize("kind", [int, float])
def test_columns_of_parquet_that_would_replace_each_other_are_refused(kind, tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra 'lerobot')")
    parquet = pytest.importorskip("pyarrow.parquet")
    table = pyarrow.table(columns_of(q=FRAMES[:6].tolist(), q_0=np.zeros(6, kind)))
    parquet.write_table(table, tmp_path / "run.parquet")
    with pytest.raises(DataError, match="two entries have a column q_0: rename one of them"):
        read_tables(tmp_path)


def test_columns_of_parquet_with_one_name_or_no_numbers_are_refused(tmp_path):
    pyarrow = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra 'lerobot')")
    parquet = pytest.importorskip("pyarrow.parquet")
    file = tmp_path / "run.parquet"
    parquet.write_table(pyarrow.table([np.arange(6)] * 2, names=["x", "x"]), file)
    with pytest.raises(DataError, match="run.parquet: two columns are named x"):
        read_tables(tmp_path)
    parquet.write_table(pyarrow.table({"x": pyarrow.array([[]] * 6, pyarrow.list_(pyarrow.float32()))}), file)
    with pytest.raises(DataError, match="run.parquet: column 'x' has rows of 0 numbers"):
        read_tables(tmp_path)


def test_a_row_without_a_time_has_no_camera_frame(tmp_path):
    """Its frame would be the last one."""
    time = np.where(np.arange(6) == 2, np.nan, np.arange(6) / 10)
    np.savez(tmp_path / "a.npz", states=FRAMES, actions=np.ones((6, 1)), time=time)
    (tmp_path / "a").mkdir()
    np.save(tmp_path / "a/top.npy", np.zeros((6, 2, 2, 3), np.uint8))
    np.save(tmp_path / "a/top_times.npy", np.arange(6) / 10)
    with pytest.raises(DataError, match="a.npz: camera 'top': no frame for row 2 at nan s"):
        read_tables(tmp_path, control_hz=10)


def test_what_is_not_read_is_named(tmp_path):
    extra = {"obs": np.ones((6, 3)), "reward": np.zeros(5)}
    np.savez(tmp_path / "a.npz", states=FRAMES, actions=np.ones((5, 1)), control_hz=30.0, **extra)
    recordings = read_tables(tmp_path)
    joined = "obs (a row per frame: join it to 'states' if the policy needs it)"
    assert recordings.skipped == (joined, "reward") and recordings.states[0].shape == FRAMES.shape


@pytest.mark.parametrize("name", ["state", "observations"])
def test_next_observations_say_where_episodes_end(name, tmp_path):
    """D4RL's ``qlearning_dataset`` leaves out ``timeouts``: all episodes would be one."""
    frames, rows = np.random.default_rng(0).normal(size=(13, 2)), np.r_[:6, 7:12]  # no transition from 6 to 7
    entries = {name: frames[rows], f"next_{name}": frames[rows + 1].astype(np.float32), "actions": np.ones((11, 1))}
    np.savez(tmp_path / "a.npz", terminals=np.arange(11) == 2, **entries)
    found = read_tables(tmp_path, control_hz=20)
    assert [len(each) for each in found.states] == [3, 4, 6] and found.num_labels == 10
    np.testing.assert_allclose(np.concatenate(found.states), frames, atol=1e-6)
    assert any(said.startswith(f"next_{name} (except the last of episodes, which end") for said in found.skipped)
    shuffled = np.random.default_rng(1).permutation(11)
    np.savez(tmp_path / "a.npz", **{key: values[shuffled] for key, values in entries.items()})
    with pytest.raises(DataError, match=rf"next_{name} is not the next row of {name} in \d+ of 11 rows: sort"):
        read_tables(tmp_path, control_hz=20)


def test_the_last_action_of_an_episode_leads_to_its_next_observation(tmp_path):
    """The added frame goes on with clock and counter, and shows the last picture; its own action is unknown."""
    frames, rows = np.random.default_rng(0).normal(size=(14, 2)), np.r_[:6, 7:13]
    entries = {"obs": frames[rows], "next_obs": frames[rows + 1], "actions": rows[:, None], "timeouts": rows % 7 == 5}
    np.savez(tmp_path / "a.npz", time=rows % 7 / 20, frame_index=rows % 7, **entries)
    (tmp_path / "a").mkdir()
    np.save(tmp_path / "a/top.npy", np.zeros((12, 2, 2, 3), np.uint8))
    found = read_tables(tmp_path)
    np.testing.assert_array_equal(found.states, frames.reshape(2, 7, 2))
    assert np.array_equal(found.actions, rows.reshape(2, 6, 1)) and found.control_hz == pytest.approx(20)
    assert [clip.numbers for clip in found.cameras["top"]] == [(0, 1, 2, 3, 4, 5, 5), (6, 7, 8, 9, 10, 11, 11)]
    entries["next_obs"][5] = np.nan  # not recorded
    np.savez(tmp_path / "a.npz", **entries | {"actions": rows[:11, None]})
    with pytest.raises(DataError, match="it holds 2 episodes and 11 actions for 12 frames"):
        read_tables(tmp_path, control_hz=20)
    np.savez(tmp_path / "a.npz", **entries)
    assert [len(steps) for steps in read_tables(tmp_path, control_hz=20, drop_columns=["top"]).states] == [6, 7]


def test_faults_of_all_files_are_named(tmp_path):
    np.savez(tmp_path / "a.npz", pictures=FRAMES)
    (tmp_path / "b.csv").write_text("x,y\n1,2\n3\n")
    (tmp_path / "c.csv").write_text("x,y\n1,left\n3,4\n")
    (tmp_path / "d.parquet").write_bytes(b"no parquet")
    with pytest.raises(DataError) as caught:
        read_tables(tmp_path)
    text = str(caught.value)
    assert "a.npz: has no states: wanted one of states" in text and "it holds pictures" in text
    assert "b.csv: line 3 has 1 fields, the header has 2" in text
    assert "c.csv: line 2, column 'y': 'left' is no number" in text
    assert "d.parquet: it is no parquet file, or damaged" in text


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x": [0.0, 1.0]}, "no file has time stamps"),
        ({"action": [0.0, 1.0], "time": [0.0, 0.1]}, "has no state columns, only action, time"),
    ],
)
def test_tables_without_a_rate_or_states(columns, message, tmp_path):
    write_csv(tmp_path / "run.csv", columns)
    with pytest.raises(DataError, match=message):
        read_tables(tmp_path)


def test_a_rate_that_is_given_needs_no_time_stamps(tmp_path):
    write_csv(tmp_path / "run.csv", {"x": [0.0, 1.0], "action": [0.0, 1.0]})
    assert read_tables(tmp_path, control_hz=30).control_hz == 30
    with pytest.raises(DataError, match=r"unknown column in action_columns .*: 'akcion'; did you mean 'action'"):
        read_tables(tmp_path, control_hz=30, action_columns=["akcion"])


@pytest.mark.parametrize("content", [b"", b"PK no archive", b"\x93NUMPY", None])
def test_damaged_archives_are_named(content, tmp_path):
    np.savez(tmp_path / "a.npz", states=FRAMES)
    damaged = (tmp_path / "a.npz").read_bytes().replace(b"PK\1\2", b"PK\1\3")  # of the list of entries
    (tmp_path / "a.npz").write_bytes(damaged if content is None else content)
    with pytest.raises(DataError, match=r"a\.npz: "):
        read_tables(tmp_path)


@pytest.mark.parametrize(
    ("header", "message"), [("time,x,y,x", "columns 2 and 4 are both named 'x'"), ("time,,x,y", "column 2 has no name")]
)
def test_columns_that_would_be_lost_are_refused(header, message, tmp_path):
    (tmp_path / "a.csv").write_text(header + "\n0,0.1,1,2\n1,0.2,1,2\n")
    with pytest.raises(DataError, match=message):
        read_tables(tmp_path)


def test_dates_are_time_stamps(tmp_path):
    times = np.datetime64("2024-01-01T00:00:00", "us") + np.arange(6) * np.timedelta64(50, "ms")
    write_csv(tmp_path / "run.csv", columns_of(action=[0.0] * 6) | {"timestamp": times.tolist()})
    assert read_tables(tmp_path).control_hz == pytest.approx(20)
    parquet = pytest.importorskip("pyarrow.parquet")
    (tmp_path / "run.csv").unlink()
    for kind in ("datetime64[us]", "datetime64[ns]", "timedelta64[ms]"):
        stamps = times - times[0] if kind[0] == "t" else times
        table = pytest.importorskip("pyarrow").table(columns_of(action=[0.0] * 6) | {"timestamp": stamps.astype(kind)})
        parquet.write_table(table, tmp_path / "run.parquet")
        assert read_tables(tmp_path).control_hz == pytest.approx(20)


def test_decimal_numbers_are_states(tmp_path):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    exact = pyarrow.array([0.5 * row for row in range(6)]).cast(pyarrow.decimal128(9, 3))
    parquet.write_table(pyarrow.table(columns_of(action=[0.0] * 6) | {"x": exact}), tmp_path / "run.parquet")
    found = read_tables(tmp_path)
    assert found.state_names == ("x", "y") and found.states[0][:, 0].tolist() == [0, 0.5, 1, 1.5, 2, 2.5]


def test_archives_with_a_rate_beside_tables_with_time_stamps(tmp_path):
    states = {"states": FRAMES, "state_names": ["x", "y"]}
    np.savez(tmp_path / "robot.npz", actions=np.ones((6, 1)), control_hz=25, **states)
    video = columns_of(frame=[*range(6)], time_ms=[20 * row for row in range(6)])
    del video["timestamp"]
    write_csv(tmp_path / "video.csv", video)
    with warnings.catch_warnings(action="error"):  # the median step lies between both rates
        found = read_tables(tmp_path, resample=12.5, action_kind="velocity")
    assert [len(frames) for frames in found.states] == [3, 2] and found.num_labels == 2
    np.testing.assert_allclose(found.states[1], [FRAMES[0], FRAMES[4]])
    with pytest.raises(DataError, match="no file has time stamps"):  # the rate of the robot is not that of the video
        read_tables(tmp_path, drop_columns=["time_ms", "frame"])
    own = {"time_ms": 20.0 * np.arange(6), "frame": np.arange(6)}
    np.savez(tmp_path / "robot.npz", actions=np.ones((6, 1)), control_hz=25, **states, **own)
    assert read_tables(tmp_path).control_hz == pytest.approx(50)  # stamps of its own are kept
    write_csv(tmp_path / "video.csv", video | {"confidence": [1.0] * 6})
    with pytest.raises(DataError, match=r"has confidence besides; .* or drop .* with drop_columns \(--drop-columns\)"):
        read_tables(tmp_path, resample=12.5)
