# This source code is licensed under the MIT license found in the LICENSE file.
"""Camera frames of LeRobot data sets: what is written is what is read, from pictures and from videos."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("pyarrow")
import pyarrow as pa
import pyarrow.parquet as pq
from camera_sets import episode, write_camera_set

from torchrl_koap.data import read_recordings
from torchrl_koap.data.formats.lerobot_frames import read_image_episodes
from torchrl_koap.data.formats.writers import LeRobotWriter
from torchrl_koap.files import DataError


@pytest.mark.parametrize("embodiment", ["robot", "hand"])
def test_what_is_read_is_what_was_written(tmp_path, embodiment):
    read = read_image_episodes(write_camera_set(tmp_path / "set", embodiment))
    for seed, found in enumerate(read):
        wanted = episode(embodiment, 6 + seed, seed)
        assert np.array_equal(found.frames, wanted.frames) and found.embodiment == embodiment
        np.testing.assert_allclose(found.state, wanted.state, rtol=1e-6)
        if embodiment == "robot":
            np.testing.assert_allclose(found.action, wanted.action, rtol=1e-6)
        else:
            assert found.action is None


def test_the_reader_of_any_robot_takes_the_numbers_and_skips_the_camera(tmp_path):
    recordings = read_recordings(write_camera_set(tmp_path / "set", "robot"))
    assert recordings.state_names == ("x", "y", "z") and recordings.control_hz == 10
    assert list(recordings.skipped) == ["observation.images.third_person", "timestamp"]


def test_bad_data_sets_are_refused(tmp_path):
    robot, hand = (write_camera_set(tmp_path / who, who) for who in ("robot", "hand"))
    with pytest.raises(DataError, match="holds 2 episodes, asked for 5"):
        read_image_episodes(robot, episodes=5)
    with pytest.raises(DataError, match="embodiment 'hand', wanted 'robot'"):
        read_image_episodes(hand, embodiment="robot")
    with pytest.raises(DataError, match=r"no camera 'wrist' \(cameras: observation.images.third_person\)"):
        read_image_episodes(robot, camera="wrist")
    with pytest.raises(FileExistsError, match="is not empty; choose another folder"):
        write_camera_set(robot, "robot")
    (robot / "meta" / "info.json").unlink()
    with pytest.raises(DataError, match="no finished data set"):
        read_image_episodes(robot)


def test_only_the_first_episodes_are_read(tmp_path):
    assert len(read_image_episodes(write_camera_set(tmp_path / "set", "hand", count=3), episodes=2)) == 2


def test_several_cameras_are_told_apart(tmp_path):
    root = write_camera_set(tmp_path / "set", "hand", count=1)
    info = json.loads((root / "meta/info.json").read_text())
    other, own = "observation.images.wrist", "observation.images.third_person"
    info["features"][other] = info["features"][own]
    (root / "meta/info.json").write_text(json.dumps(info))
    (file,) = (root / "data").rglob("*.parquet")
    table = pq.read_table(file)
    pq.write_table(table.append_column(other, table[own].take(list(range(len(table)))[::-1])), file)
    with pytest.raises(DataError, match="several cameras: choose one"):
        read_image_episodes(root)
    (one,), (backwards,) = (read_image_episodes(root, camera=name) for name in (own, other))
    assert np.array_equal(one.frames[::-1], backwards.frames)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_frames_of_a_video(version, tmp_path):
    """In 3.0 the second episode begins behind the first one, in the same file."""
    iio = pytest.importorskip("imageio.v3")
    root, camera, lengths = tmp_path / "set", "observation.images.front", (4, 3)
    writer = LeRobotWriter(root, fps=10, state_names="x")
    frames = [np.full((length, 8, 8, 3), 0, np.uint8) for length in lengths]
    for number, film in enumerate(frames):
        film[np.arange(len(film)), number, np.arange(len(film))] = 255  # a white dot that moves
        writer.add(np.zeros((len(film), 1)), frames=film)
    writer.close()
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][camera] = {"dtype": "video", "shape": [8, 8, 3], "names": None}
    info["video_path"] = "{video_key}/{episode_index}.gif"
    films = {f"{number}.gif": film for number, film in enumerate(frames)}
    if version == "v3.0":
        info["video_path"], films = "{video_key}/{chunk_index}-{file_index}.gif", {"0-5.gif": np.concatenate(frames)}
        file = root / "meta/episodes/chunk-000/file-000.parquet"
        about = {"chunk_index": [0, 0], "file_index": [5, 5], "from_timestamp": [0.0, 0.4]}
        table = pq.read_table(file)
        for name, values in about.items():
            table = table.append_column(f"videos/{camera}/{name}", pa.array(values))
        pq.write_table(table, file)
    else:
        (root / "meta/episodes/chunk-000/file-000.parquet").unlink()
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / camera).mkdir()
    for name, film in films.items():
        iio.imwrite(root / camera / name, film, loop=0)
    read = read_image_episodes(root)
    assert all(np.array_equal(found.frames, film) for found, film in zip(read, frames, strict=True))
    (root / camera / next(reversed(films))).unlink()
    with pytest.raises(DataError, match=r"episode \d: .*gif"):
        read_image_episodes(root)
