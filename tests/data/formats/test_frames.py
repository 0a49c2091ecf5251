# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests references to camera frames: they return the recorded frames and name what is missing."""

import json

import numpy as np
import pytest

pytest.importorskip("pyarrow")
import pyarrow.parquet as pq
from camera_sets import episode, read, write_camera_set
from PIL import Image

from torchrl_koap.data import read_recordings, save_demonstrations
from torchrl_koap.data.formats.frames import Clip, fault_of
from torchrl_koap.data.quality import drop_short, trim_still
from torchrl_koap.files import DataError


def film(length, seed=0, size=(8, 10)):
    return np.random.default_rng(seed).integers(0, 256, (length, *size, 3), dtype=np.uint8)


def write_tables(folder, lengths=(6, 5), clock=False):
    """Tables with two cameras beside them: a folder of pictures, and an array."""
    for number, length in enumerate(lengths):
        states = np.random.default_rng(number).normal(size=(length, 2))
        further = {"timestamp": np.arange(length) / 10} if clock else {}
        (folder / f"run_{number}" / "top").mkdir(parents=True)
        np.savez(folder / f"run_{number}.npz", states=states, actions=states[:-1], control_hz=10.0, **further)
        for index, frame in enumerate(film(length, number)):
            Image.fromarray(frame).save(folder / f"run_{number}" / "top" / f"{index:06d}.png")
        np.save(folder / f"run_{number}" / "wrist.npy", film(length, 7 + number))
    return folder


@pytest.mark.parametrize("clock", [False, True])
def test_pictures_and_arrays_beside_tables(tmp_path, clock):
    recordings = read_recordings(write_tables(tmp_path, clock=clock))
    assert list(recordings.cameras) == ["top", "wrist"] and not set(recordings.skipped) - {"timestamp"}
    for index, length in enumerate((6, 5)):
        np.testing.assert_array_equal(read(recordings, "top", index), film(length, index))
        np.testing.assert_array_equal(read(recordings, "wrist", index), film(length, 7 + index))
    assert list(read_recordings(tmp_path, drop_columns=["wrist"]).cameras) == ["top"]


def test_what_is_no_camera_beside_tables_is_listed_and_a_camera_that_is_there_twice_refused(tmp_path):
    for name in ("a", "b"):
        np.savez(tmp_path / f"{name}.npz", states=np.eye(4), actions=np.eye(4), control_hz=10)
        (tmp_path / name).mkdir()
        (tmp_path / name / "top.mp4").touch()
    assert read_recordings(tmp_path).skipped == ("a, b: top.mp4 (no frames)",)
    np.save(tmp_path / "b/top.npy", np.zeros((4, 2, 2, 3), np.uint8))
    (tmp_path / "b/top").mkdir()
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "b/top/0.png")
    with pytest.raises(DataError, match="b.npz: camera 'top' is there twice, as top and top.npy"):
        read_recordings(tmp_path)


def test_frames_on_a_clock_of_their_own_are_matched(tmp_path):
    """A camera at 30 frames a second, a little late, beside rows at 10."""
    write_tables(tmp_path, lengths=(6,), clock=True)
    frames, times = film(18, 3), np.arange(18) / 30 + 0.004
    np.save(tmp_path / "run_0" / "wrist.npy", frames)
    np.save(tmp_path / "run_0" / "wrist_times.npy", times)
    np.testing.assert_array_equal(read(read_recordings(tmp_path), "wrist"), frames[::3])
    table = dict(np.load(tmp_path / "run_0.npz"))
    time = table.pop("timestamp")
    for clock in ({"time_ms": 1e3 * time}, {"stamp.secs": time // 1, "stamp.nsecs": time % 1 * 1e9}):  # as ROS
        np.savez(tmp_path / "run_0.npz", **clock, **table)
        np.testing.assert_array_equal(read(read_recordings(tmp_path), "wrist"), frames[::3])
    for odd in (np.where(times > 0.5, np.nan, times), times[[1, 0, *range(2, 18)]]):
        np.save(tmp_path / "run_0" / "wrist_times.npy", odd)
        with pytest.raises(DataError, match="camera 'wrist': its times do not increase, or are missing"):
            read_recordings(tmp_path)
    np.save(tmp_path / "run_0" / "wrist_times.npy", times[:9])
    with pytest.raises(DataError, match=r"wrist_times.npy needs 18 times and a clock, got times .9."):
        read_recordings(tmp_path)
    np.save(tmp_path / "run_0" / "wrist.npy", frames[:9])
    with pytest.raises(DataError, match="camera 'wrist': no frame for row 5 at 0.5 s, the nearest is 0.229 s away"):
        read_recordings(tmp_path)


@pytest.mark.parametrize("count", [0, 1])
def test_a_camera_with_fewer_than_two_times_is_refused_unless_its_recording_is_as_short(tmp_path, count):
    write_tables(tmp_path, lengths=(6, 1), clock=True)
    np.save(tmp_path / "run_1" / "wrist_times.npy", [0.004])
    recordings = read_recordings(tmp_path)
    assert len(recordings.states) == 1 and recordings.skipped[0] == "run_1.npz (fewer than two frames)"
    np.save(tmp_path / "run_0" / "wrist.npy", film(count))
    np.save(tmp_path / "run_0" / "wrist_times.npy", np.zeros(count))
    with pytest.raises(DataError, match=f"camera 'wrist': wanted two or more frames for 6 rows, got {count}"):
        read_recordings(tmp_path)


def test_pictures_may_count_from_any_number(tmp_path):
    folder = write_tables(tmp_path, lengths=(6,), clock=True) / "run_0" / "top"
    for index in range(6):
        (folder / f"{index:06d}.png").rename(folder / f"take_{index + 7}.png")
    assert read_recordings(tmp_path).cameras["top"][0].numbers == tuple(range(7, 13))
    (folder / "take_9.png").unlink()
    np.save(tmp_path / "run_0" / "top_times.npy", [0.0, 0.1, 0.32, 0.4, 0.5])
    assert read_recordings(tmp_path).cameras["top"][0].numbers == (7, 8, 8, 10, 11, 12)


def test_pictures_of_a_palette_are_colours_and_all_have_one_size(tmp_path):
    colour = np.full((4, 4, 3), (250, 0, 0), np.uint8)
    Image.fromarray(colour).convert("P", palette=Image.Palette.ADAPTIVE).save(tmp_path / "0.png")
    np.testing.assert_array_equal([*Clip(str(tmp_path), (0,)).read()], [colour])
    cases = [(film(1)[0], "is 8 x 10, the camera's others are 4 x 4"), (colour[0], "has shape")]
    for number, (other, said) in enumerate(cases, 1):
        Image.fromarray(other).save(tmp_path / f"{number}.png")
        with pytest.raises(ValueError, match=f"frame {number} {said}"):
            list(Clip(str(tmp_path), (0, number)).read())


def test_cameras_are_cut_together_with_states(tmp_path):
    states = np.r_[np.zeros(5), np.arange(20.0), np.full(5, 19.0)][:, None]
    (tmp_path / "a").mkdir()
    np.savez(tmp_path / "a.npz", states=states, actions=states[:-1], control_hz=10.0)
    np.save(tmp_path / "a" / "top.npy", film(30))
    np.savez(tmp_path / "b.npz", states=states[:9], actions=states[:8], control_hz=10.0)
    (tmp_path / "b").mkdir()
    np.save(tmp_path / "b" / "top.npy", film(9, 1))
    recordings = read_recordings(tmp_path)
    short = drop_short(recordings)
    assert len(short.cameras["top"]) == len(short.states) == 1
    cut = trim_still(recordings)
    assert [len(clip) for clip in cut.cameras["top"]] == [len(frames) for frames in cut.states]
    assert len(cut.states[0]) < 30
    np.testing.assert_array_equal(read(cut, "top")[5], film(30)[int(np.argmax(states == cut.states[0][5]))])


def test_episodes_of_one_table_have_their_own_frames(tmp_path):
    table = "x,action_0,episode\n" + "".join(f"{row * row},{row},{row // 4}\n" for row in range(8))
    (tmp_path / "all.csv").write_text(table)
    (tmp_path / "all").mkdir()
    np.save(tmp_path / "all" / "top.npy", film(8))
    recordings = read_recordings(tmp_path, control_hz=10)
    np.testing.assert_array_equal(read(recordings, "top", 1), film(8)[4:])


@pytest.mark.parametrize(("behind", "name"), [(False, "demo.hdf5"), (True, "demo.H5")])
def test_cameras_of_robomimic(tmp_path, behind, name):
    h5py = pytest.importorskip("h5py")
    frames, joints = film(7), np.random.default_rng(0).normal(size=(7, 2))
    with h5py.File(tmp_path / name, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["obs/joints"], demo["obs/agentview_image"] = joints[:6], frames[:6]
        demo["actions"] = np.zeros((6, 2))
        if behind:
            demo["next_obs/joints"], demo["next_obs/agentview_image"] = joints[1:], frames[1:]
    recordings = read_recordings(tmp_path / name, control_hz=20)
    assert len(recordings.states[0]) == 6 + behind and not recordings.skipped
    np.testing.assert_array_equal(read(recordings, "agentview_image"), frames[: 6 + behind])


@pytest.mark.parametrize("entry", ["observations/images/top", "data/demo_0/obs/top"])
def test_frames_that_an_hdf5_file_no_longer_holds_are_missing(tmp_path, entry):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file[entry] = film(4)
    clip = Clip(str(tmp_path / "a.hdf5"), tuple(range(5)), entry)
    with pytest.raises(ValueError, match=r"frame 4 is missing: .*a.hdf5 has 4"):
        list(clip.read())
    np.testing.assert_array_equal(list(clip.take(range(4)).read()), film(4))
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        file["data/demo_0/next_obs/top"] = film(5)[1:]
    held = 5 if "/obs/" in entry else 4
    with pytest.raises(ValueError, match=f"frame {held} is missing: .*a.hdf5 has {held}"):
        list(Clip(clip.file, tuple(range(6)), entry).read())


@pytest.mark.parametrize("embodiment", ["robot", "hand"])
def test_pictures_of_lerobot(tmp_path, embodiment):
    recordings = read_recordings(write_camera_set(tmp_path / "set", embodiment), action_dim=7)
    assert recordings.state_names == ("x", "y", "z") and list(recordings.skipped) == ["timestamp"]
    for seed in range(2):
        frames, states, actions = episode(embodiment, 6 + seed, seed)
        np.testing.assert_array_equal(read(recordings, "third_person", seed), frames)
        np.testing.assert_allclose(recordings.states[seed], states, rtol=1e-6)
        if embodiment == "robot":
            np.testing.assert_allclose(recordings.actions[seed], actions, rtol=1e-6)
    assert bool(recordings.num_labels) == (embodiment == "robot")


@pytest.mark.parametrize(
    ("other", "names"),
    [
        ("observation.images.wrist", ("third_person", "wrist")),
        ("observation.images.depth.third_person", ("images_third_person", "images_depth_third_person")),
    ],
)
def test_several_cameras_of_lerobot_are_told_apart(other, names, tmp_path):
    root = write_camera_set(tmp_path / "set", "robot", count=1)
    info = json.loads((root / "meta/info.json").read_text())
    own = "observation.images.third_person"
    info["features"][other] = info["features"][own]
    (root / "meta/info.json").write_text(json.dumps(info))
    (file,) = (root / "data").rglob("*.parquet")
    table = pq.read_table(file)
    pq.write_table(table.append_column(other, table[own].take(list(range(len(table)))[::-1])), file)
    recordings = read_recordings(root)
    assert tuple(recordings.cameras) == names
    assert np.array_equal(read(recordings, names[0])[::-1], read(recordings, names[1]))


@pytest.mark.parametrize("cameras", [5, {"top": 5}, {"top": [{"file": "a"}]}, {"top": [{"file": "a", "numbers": 1}]}])
def test_damaged_references_of_a_data_set_are_named(cameras, tmp_path):
    folder = save_demonstrations(tmp_path / "arm", read_recordings(write_tables(tmp_path / "recordings")))
    assert list(read_recordings(folder).cameras) == ["top", "wrist"]
    about = json.loads((folder / "ted" / "about.json").read_text())
    about["notes"]["cameras"] = cameras
    (folder / "ted" / "about.json").write_text(json.dumps(about))
    with pytest.raises(DataError, match="arm/ted cannot be used: the notes in its about.json are damaged: .*cameras"):
        read_recordings(folder)


def test_what_is_missing_is_named(tmp_path):
    write_tables(tmp_path)
    (tmp_path / "run_1" / "top" / "000002.png").unlink()
    with pytest.raises(DataError, match=r"run_1.npz.*camera 'top': frame 2 is missing: give .* in top_times.npy"):
        read_recordings(tmp_path)
    (tmp_path / "run_1" / "top" / "000003.png").unlink()
    (tmp_path / "run_1" / "top" / "000004.png").unlink()
    said = r"run_1.npz: camera 'top' has 2 frames .*give .* top_times.npy .*drop the camera with .* top"
    with pytest.raises(DataError, match=said):
        read_recordings(tmp_path)
    (tmp_path / "run_1" / "wrist.npy").unlink()
    with pytest.raises(DataError, match="camera 'wrist' has no frames in run_1.npz"):
        read_recordings(tmp_path, drop_columns=["top"])
    with pytest.raises(DataError, match="must end in a unique number"):
        (tmp_path / "run_1" / "top" / "other_0.png").write_bytes(b"")
        read_recordings(tmp_path)


@pytest.mark.parametrize(
    ("frame", "says"),
    [
        (np.zeros((8, 8), np.uint8), r"has shape \[8, 8\], wanted \[H, W, 3\]: save one image as RGB"),
        (np.zeros((8, 8, 4), np.uint8), r"has shape \[8, 8, 4\]"),
        (np.zeros((3, 8, 8), np.uint8), r"has shape \[3, 8, 8\].*the three colours last"),
        (np.zeros((8, 8, 1), np.float32), r"has shape \[8, 8, 1\].* last \(depth maps are not used\)$"),
        (np.zeros((8, 8, 3)), "is float64, wanted uint8 in 0 to 255: scale and round it"),
        (np.zeros((8, 9, 3), np.uint8), "is 8 x 9, the camera's others are 8 x 8: resize them alike"),
    ],
)
def test_frames_of_another_kind_are_refused(frame, says, tmp_path):
    assert fault_of(np.zeros((8, 8, 3), np.uint8), (8, 8)) is None
    np.save(tmp_path / "top.npy", frame[None])
    with pytest.raises(ValueError, match=f"frame 0 {says}"):
        list(Clip(str(tmp_path / "top.npy"), (0,)).read((8, 8)))


def test_a_camera_whose_first_frame_is_none_is_refused_when_it_is_read_in(tmp_path):
    write_tables(tmp_path)
    for file in tmp_path.glob("run_*/wrist.npy"):
        np.save(file, np.load(file).transpose(0, 3, 1, 2) / 255)
    with pytest.raises(DataError, match=r"run_0.npz: camera 'wrist': frame 0 has shape .*last .*; or drop .* wrist$"):
        read_recordings(tmp_path)
    assert list(read_recordings(tmp_path, drop_columns=["wrist"]).cameras) == ["top"]


def test_damaged_pictures_are_named(tmp_path):
    write_tables(tmp_path)
    clip = read_recordings(tmp_path).cameras["top"][0]
    (tmp_path / "run_0" / "top" / "000003.png").write_bytes(b"PNG")
    with pytest.raises(ValueError, match=r"frame 3 \(000003.png\) is no readable image: cannot identify image file$"):
        list(clip.read())
    (tmp_path / "run_0" / "top" / "000003.png").unlink()
    with pytest.raises(ValueError, match="frame 3 is missing in"):
        list(clip.read())
