# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests frames of videos: the recorded ones are read, and what is missing or damaged is named."""

import json

import numpy as np
import pytest

pytest.importorskip("pyarrow")
import pyarrow as pa
import pyarrow.parquet as pq
from camera_sets import read

from torchrl_koap.data import read_recordings
from torchrl_koap.data.formats.frames import Clip
from torchrl_koap.data.formats.writers import LeRobotWriter


def write_videos(root, version, lengths=(14, 11)):
    """A LeRobot data set with one video of a dot that moves; in 3.0 both episodes lie in one file."""
    av = pytest.importorskip("av")
    camera = "observation.images.front"
    writer = LeRobotWriter(root, fps=10, state_names="x", action_names="a")
    films = [np.full((length, 64, 64, 3), 0, np.uint8) for length in lengths]
    for number, frames in enumerate(films):
        for index, frame in enumerate(frames):
            frame[16 * number : 16 * number + 16, 4 * index : 4 * index + 4] = 255
        writer.add(np.random.default_rng(0).normal(size=(len(frames), 1)), np.ones((len(frames) - 1, 1)))
    writer.close()
    info = json.loads((root / "meta/info.json").read_text())
    info["features"][camera] = {"dtype": "video", "shape": [64, 64, 3], "names": None}
    info["video_path"] = "{video_key}/{episode_index}.mp4"
    files = {f"{number}.mp4": frames for number, frames in enumerate(films)}
    file = root / "meta/episodes/chunk-000/file-000.parquet"
    if version == "v3.0":
        info["video_path"], files = "{video_key}/{chunk_index}-{file_index}.mp4", {"0-5.mp4": np.concatenate(films)}
        about = {"chunk_index": [0, 0], "file_index": [5, 5], "from_timestamp": [0.0, lengths[0] / 10]}
        table = pq.read_table(file)
        for name, values in about.items():
            table = table.append_column(f"videos/{camera}/{name}", pa.array(values))
        pq.write_table(table, file)
    else:
        file.unlink()
    (root / "meta/info.json").write_text(json.dumps(info))
    (root / camera).mkdir()
    for name, frames in files.items():
        with av.open(root / camera / name, "w") as container:
            stream = container.add_stream("libx264", rate=10)
            stream.width, stream.height, stream.pix_fmt = 64, 64, "yuv420p"
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
    return films, root / camera / next(reversed(files))


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_frames_of_a_video(version, tmp_path):
    """In 3.0 the second episode begins behind the first one, in the same file."""
    (films, last), recordings = write_videos(tmp_path, version), read_recordings(tmp_path)
    for index, frames in enumerate(films):
        off = np.abs(read(recordings, "front", index).astype(int) - frames)  # a video is not exact
        assert off.mean((1, 2, 3)).max() < 3
        assert (read(recordings, "front", index)[..., 0] > 128).sum((1, 2)).min() > 32
    last.write_bytes(b"no video")
    with pytest.raises(ValueError, match=r"frame \d+: PyAV cannot decode .*mp4.*ffmpeg -i OLD"):
        read(recordings, "front", 1)
    last.unlink()
    with pytest.raises(ValueError, match=r"frame \d+: .*mp4 is missing: convert the data again"):
        read(recordings, "front", 1)


def test_frames_of_a_video_are_not_found_without_a_rate(tmp_path):
    write_videos(tmp_path, "v3.0")
    info = json.loads((tmp_path / "meta/info.json").read_text())
    del info["fps"]
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    recordings = read_recordings(tmp_path, control_hz=10)
    assert not recordings.cameras and "front (info.json holds no fps, by which its frames" in recordings.skipped[0]


def test_a_video_with_fewer_frames_than_rows(tmp_path):
    write_videos(tmp_path, "v2.1")
    clip = read_recordings(tmp_path).cameras["front"][1]
    with pytest.raises(ValueError, match=r"frame 12 is missing: .*1.mp4 ends with frame 10"):
        list(Clip(clip.file, (*clip.numbers, 12)).read())


def test_videos_that_are_not_there_are_skipped(tmp_path):
    _, last = write_videos(tmp_path, "v3.0")
    last.unlink()
    recordings = read_recordings(tmp_path)
    assert not recordings.cameras and "observation.images.front (its videos are not here)" in recordings.skipped


def test_videos_need_an_extra(tmp_path, monkeypatch):
    write_videos(tmp_path, "v3.0")
    clip = read_recordings(tmp_path).cameras["front"][0]
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(RuntimeError, match=r"pip install 'torchrl_koap\[video\]'"):
        next(clip.read())
