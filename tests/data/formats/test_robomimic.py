# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests HDF5 files in robomimic's layout."""

import io
import json
import shutil

import numpy as np
import pytest
from PIL import Image

from torchrl_koap.data.formats import read_recordings
from torchrl_koap.data.formats.robomimic import read_robomimic
from torchrl_koap.files import DataError

h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra 'hdf5')")


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "low_dim.hdf5"
    with h5py.File(path, "w") as stream:
        data = stream.create_group("data")
        data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": 20}})
        for index, length in ((10, 5), (2, 4)):
            demo = data.create_group(f"demo_{index}")
            demo["obs/eef"] = np.full((length, 3), float(index))
            demo["obs/width"] = np.arange(float(length))
            demo["obs/camera"] = np.zeros((length, 4, 4, 3), np.uint8)
            if index == 2:
                demo["actions"] = np.ones((length, 7))
    return path


def test_demonstrations_in_the_order_of_their_numbers(file):
    recordings = read_robomimic(file)
    assert recordings.sources == ("demo_2", "demo_10") and recordings.control_hz == 20
    assert recordings.state_names == ("eef_0", "eef_1", "eef_2", "width")
    assert not recordings.skipped and [len(clip) for clip in recordings.cameras["camera"]] == [4, 5]
    assert recordings.num_labels == 3 and np.isnan(recordings.actions[1]).all()
    np.testing.assert_array_equal(recordings.states[0][:, 3], np.arange(4.0))


@pytest.mark.parametrize("form", ["padded", "of their own lengths"])
def test_frames_that_are_compressed_are_a_camera_and_no_columns(form, file):
    frame = np.kron([[0, 255], [255, 0]], np.ones((8, 8)))[..., None].repeat(3, -1).astype(np.uint8)
    content = io.BytesIO()
    Image.fromarray(frame).save(content, "PNG" if form == "padded" else "JPEG", quality=95)
    content = np.frombuffer(content.getvalue(), np.uint8)
    with h5py.File(file, "a") as stream:
        for demo in stream["data"].values():
            length = len(demo["obs/width"])
            if form == "padded":
                demo["obs/top"] = np.pad(content, (0, 9))[None].repeat(length, 0)
            else:
                rows = demo["obs"].create_dataset("top", (length,), h5py.vlen_dtype(np.uint8))
                for row in range(length):
                    rows[row] = content
    recordings = read_robomimic(file)
    assert recordings.state_names == ("eef_0", "eef_1", "eef_2", "width")
    seen = np.stack(list(recordings.cameras["top"][1].read()))
    assert seen.shape == (5, 16, 16, 3) and np.abs(seen.astype(int) - frame).max() < 16


def test_a_folder_in_the_layout_of_aloha(tmp_path):
    for number, length in ((10, 5), (2, 4)):
        with h5py.File(tmp_path / f"episode_{number}.hdf5", "w") as stream:
            stream["observations/qpos"] = np.full((length, 2), float(number))
            stream["observations/qvel"] = np.zeros((length, 2))
            stream["observations/images/top"] = np.full((length, 4, 6, 3), number, np.uint8)
            stream["base_action"] = np.zeros((length, 2))
            if number == 2:
                stream["action"] = np.ones((length, 2))
    recordings = read_recordings(tmp_path, observations=["qpos"], control_hz=50)
    assert recordings.sources == ("episode_2", "episode_10") and recordings.state_names == ("qpos_0", "qpos_1")
    assert recordings.num_labels == 3 and np.isnan(recordings.actions[1]).all()
    assert recordings.skipped == ("obs/qvel", "base_action")
    frames = list(recordings.cameras["top"][1].read())
    assert len(frames) == 5 and frames[0].shape == (4, 6, 3) and frames[0].max() == 10
    assert read_recordings(tmp_path / "episode_2.hdf5", control_hz=50).sources == ("episode_2",)


def test_a_folder_of_files_that_agree_on_their_rate(file, tmp_path):
    (tmp_path / "more").mkdir()
    for name in ("a_1.hdf5", "a_2.hdf5"):
        shutil.copy(file, tmp_path / "more" / name)
    assert read_robomimic(tmp_path / "more").sources == ("a_1/demo_2", "a_1/demo_10", "a_2/demo_2", "a_2/demo_10")
    with h5py.File(tmp_path / "more" / "a_2.hdf5", "a") as stream:
        stream["data"].attrs["env_args"] = json.dumps({"env_kwargs": {"control_freq": 50}})
    with pytest.raises(DataError, match=r"different rates: a_1.hdf5 20.0, a_2.hdf5 50.0; .* pass control_hz"):
        read_robomimic(tmp_path / "more")
    assert read_robomimic(tmp_path / "more", control_hz=20).control_hz == 20


def test_columns_that_would_replace_each_other_are_refused(file):
    with h5py.File(file, "a") as stream:
        stream["data/demo_2/obs/eef_0"] = np.zeros(4)
    with pytest.raises(DataError, match="data/demo_2: two entries have a column eef_0: rename one of them"):
        read_robomimic(file, observations=["eef", "eef_0"])


def test_chosen_observations(file):
    assert read_robomimic(file, observations=["width", "eef"]).state_names[0] == "width"


def test_the_frame_behind_the_last_action(file):
    with h5py.File(file, "a") as stream:
        demo = stream["data/demo_2"]
        demo["next_obs/eef"] = np.array([2.0, 2.0 + 1e-7, 2.0, 7.0])[:, None].repeat(3, 1)  # rounded
        demo["next_obs/width"] = np.arange(1.0, 5.0)
    recordings = read_robomimic(file)
    assert len(recordings.states[0]) == 5 and recordings.num_labels == 4
    assert recordings.cameras["camera"][0].numbers == (0, 1, 2, 3, 3)
    assert recordings.states[0][-1].tolist() == [7, 7, 7, 4]


@pytest.mark.parametrize("width", [np.arange(4.0), np.arange(4.0)[::-1]], ids=["the same frame", "another order"])
def test_next_observations_that_are_not_those_of_the_next_frame(width, file):
    with h5py.File(file, "a") as stream:
        demo = stream["data/demo_2"]
        demo["next_obs/eef"], demo["next_obs/width"] = demo["obs/eef"][:], width
    with pytest.raises(
        DataError, match="row 0 of next_obs/width is not row 1 of obs/width: .*--drop-columns. next_obs"
    ):
        read_robomimic(file)
    recordings = read_robomimic(file, drop_columns=["next_obs"])
    assert len(recordings.states[0]) == 4 and recordings.skipped == ("next_obs",)


def test_time_stamps_beside_the_observations(file):
    with h5py.File(file, "a") as stream:
        del stream["data"].attrs["env_args"]
        for demo in stream["data"].values():
            demo["timestamps"] = 7 + np.arange(len(demo["obs/width"])) / 25
            demo["frame"] = np.arange(3)  # of something else
    recordings = read_robomimic(file)
    assert recordings.control_hz == pytest.approx(25) and recordings.skipped == ("frame", "timestamps")


def test_ends_of_episodes_beside_the_observations(file):
    with h5py.File(file, "a") as stream:
        stream["data/demo_2/timeouts"] = np.array([False, True, False, True])
        stream["data/demo_10/timeouts"] = np.zeros(5)
    recordings = read_robomimic(file)
    assert recordings.sources == ("demo_2[0]", "demo_2[1]", "demo_10") and recordings.skipped == ("timeouts",)
    assert [frames[:, 3].tolist() for frames in recordings.states[:2]] == [[0, 1], [2, 3]]


def test_a_success_that_is_lost_again_ends_no_demonstration(file):
    """Robomimic's ``dones`` are 1 in every state of success."""
    with h5py.File(file, "a") as stream:
        stream["data/demo_2/dones"] = np.array([0, 1, 0, 1])
    recordings = read_robomimic(file)
    assert recordings.sources == ("demo_2", "demo_10") and recordings.skipped == ("dones",)
    assert recordings.num_labels == 3


@pytest.mark.parametrize("shape", [(0, 7), (0,)])
def test_empty_actions_are_none(shape, file):
    with h5py.File(file, "a") as stream:
        stream["data/demo_10/actions"] = np.zeros(shape)
    recordings = read_robomimic(file)
    assert recordings.num_labels == 3 and np.isnan(recordings.actions[1]).all()


@pytest.mark.parametrize("layout", ["data/demo_0/obs", "observations"])
def test_groups_in_the_observations_are_read(layout, tmp_path):
    path, joints = tmp_path / "nested.hdf5", np.arange(12.0).reshape(4, 3)
    with h5py.File(path, "w") as stream:
        stream[f"{layout}/left/joints"], stream[f"{layout}/right/joints"] = joints, -joints
        stream[f"{layout}/images/left/top"] = np.zeros((4, 2, 2, 3), np.uint8)
        stream[f"{layout}/left/text"] = np.array([b"a"] * 4)
    found = read_robomimic(path, control_hz=20, action_dim=1)
    assert found.state_names == tuple(f"{side}/joints_{index}" for side in ("left", "right") for index in range(3))
    np.testing.assert_array_equal(found.states[0], np.hstack([joints, -joints]))
    assert [*found.cameras] == ["left_top"] and found.skipped == ("obs/left/text",)
    found = read_robomimic(path, control_hz=20, action_dim=1, observations=["right/joints"])
    np.testing.assert_array_equal(found.states[0], -joints)
    with h5py.File(path, "a") as stream:
        stream[f"{layout}/left_top"] = stream[f"{layout}/images/left/top"]
    with pytest.raises(DataError, match="two entries have a column left_top: rename one of them"):
        read_robomimic(path, control_hz=20, action_dim=1)


def test_frames_do_not_replace_numbers_of_their_name(tmp_path):
    with h5py.File(tmp_path / "hand.hdf5", "w") as stream:
        stream["observations/wrist"] = np.ones((4, 2))
        stream["observations/images/wrist"] = np.zeros((4, 2, 2, 3), np.uint8)
    found = read_robomimic(tmp_path / "hand.hdf5", control_hz=20, action_dim=1)
    assert found.state_names == ("wrist_0", "wrist_1") and [*found.cameras] == ["wrist"]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"observations": 3, "actions": 2, "timeouts": 1}, "wanted the layout of .*holds actions, observations, time"),
        ({"observations": 3}, r"as in D4RL, np.savez\('arm.npz', .*h5py.File\('other.hdf5'\)"),
        (
            {"data/demo_0/states": 3},
            "data/demo_0: it has no group 'obs' yet; robomimic's dataset_states_to_obs.py adds",
        ),
        ({"observations/images": 9}, "no entry is a table of numbers; there are images"),
        ({"data/demo_0/obs/top": 9, "data/demo_0/actions": 2}, "no entry is a table of numbers; there are top"),
    ],
)
def test_other_layouts(entries, message, tmp_path):
    with h5py.File(tmp_path / "other.hdf5", "w") as stream:
        for name, width in entries.items():
            stream[name] = np.zeros((6, 2, 2, 3) if width == 9 else (6, width), np.uint8)
    with pytest.raises(DataError, match=message):
        read_robomimic(tmp_path / "other.hdf5", control_hz=20)


def test_next_observations_in_one_table_are_listed(file):
    with h5py.File(file, "a") as stream:
        stream["data/demo_2/next_obs"] = np.zeros((4, 4))
    assert read_robomimic(file).skipped == ("next_obs",)
    with h5py.File(file, "a") as stream:
        del stream["data/demo_2/next_obs"]
        stream["data/demo_2/next_obs/eef"] = np.zeros((4, 3))  # without the width
    assert read_robomimic(file).skipped == ("next_obs",)


def test_faults(file, tmp_path):
    with pytest.raises(DataError, match="data/demo_2, data/demo_10: obs has no entry 'arm'; it has camera, eef, width"):
        read_robomimic(file, observations=["arm"])
    with pytest.raises(DataError, match=r"obs/camera is \[4, 4, 4, 3\], no table of numbers: it cannot be part"):
        read_robomimic(file, observations=["camera"])
    with h5py.File(file, "a") as stream:
        del stream["data/demo_10/obs"]
        del stream["data"].attrs["env_args"]
    with pytest.raises(DataError, match="data/demo_10: it has no group 'obs'"):
        read_robomimic(file)
    (tmp_path / "text.hdf5").write_text("text")
    (tmp_path / "damaged.hdf5").write_bytes(file.read_bytes().replace(b"SNOD", b"SNOX"))  # marks of groups
    for name in ("text", "damaged"):
        with pytest.raises(DataError, match=f"{name}.hdf5 cannot be used: it is no HDF5 file, or damaged"):
            read_robomimic(tmp_path / f"{name}.hdf5")


@pytest.mark.parametrize(
    ("entry", "values", "message"),
    [
        ("obs/eef", np.zeros((4, 3)), "demo_10: its columns have different numbers of rows: 4 in .*; 5 in width"),
        ("next_obs/eef", np.zeros((5, 2)), r"demo_10: next_obs/eef is \[5, 2\], obs/eef is \[5, 3\]"),
        ("next_obs/eef", np.zeros((4, 3)), r"demo_10: next_obs/eef is \[4, 3\], obs/eef is \[5, 3\]"),
        ("actions", np.zeros((5, 6)), "demo_10: its action columns are not those of demo_2: it lacks action_6"),
    ],
)
def test_other_shapes_are_named(entry, values, message, file):
    with h5py.File(file, "a") as stream:
        demo = stream["data/demo_10"]
        if entry.startswith("next_obs"):
            demo["next_obs/width"] = demo["obs/width"][:]
        elif entry in demo:
            del demo[entry]
        demo[entry] = values
    with pytest.raises(DataError, match=message):
        read_robomimic(file)


def test_truth_values_are_numbers_and_the_rest_is_listed(file):
    with h5py.File(file, "a") as stream:
        for name in ("demo_2", "demo_10"):
            stream[f"data/{name}/obs/touch"] = stream[f"data/{name}/obs/width"][:] > 1
            stream[f"data/{name}/rewards"] = stream[f"data/{name}/obs/width"][:]
    recordings = read_robomimic(file)
    assert recordings.state_names[-2:] == ("touch", "width") and recordings.skipped == ("rewards",)
    assert recordings.states[0][:, 3].tolist() == [0, 0, 1, 1]


def test_entries_of_any_demonstration_are_listed(file):
    with h5py.File(file, "a") as stream:
        stream["data/demo_10/force"] = np.zeros((5, 6))
    assert read_robomimic(file).skipped == ("force",)


def test_a_mask_that_chooses_nothing_is_told(file):
    with h5py.File(file, "a") as stream:
        stream["mask/success"] = np.array([b"demo_2"])
    recordings = read_robomimic(file)
    assert len(recordings.states) == 2 and recordings.skipped == ("mask/success (every demonstration is read)",)
    with h5py.File(file, "a") as stream:
        del stream["data/demo_10"]
    assert read_robomimic(file).sources == ("demo_2",)
