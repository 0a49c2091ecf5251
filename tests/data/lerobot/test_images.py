# This source code is licensed under the MIT license found in the LICENSE file.
"""Data sets with camera frames: what is written is what is read, and embodiments do not mix by accident."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("pyarrow")

from torchrl_koap.data import load_ted, read_about
from torchrl_koap.data.lerobot.any_robot import read_lerobot_recordings
from torchrl_koap.data.lerobot.images import ImageDataError, ImageEpisode, ImageEpisodeWriter, read_image_episodes
from torchrl_koap.tasks import get_task
from torchrl_koap.vision.demonstrations import Source, embed_demonstrations, fit_projection


class Mean:
    """Stands for an encoder: the mean colour, repeated."""

    identity = {"weights": "none"}

    def embed(self, frames):
        return frames.float().mean((1, 2)).repeat(1, get_task("scooping").state_dim // 3)

    def features(self, frames):
        return frames.float().mean((1, 2))


def episode(embodiment, length=6, seed=0):
    generator = np.random.default_rng(seed)
    frames = generator.integers(0, 256, (length + 1, 8, 8, 3), dtype=np.uint8)
    action = generator.normal(size=(length, 7)) if embodiment == "robot" else None
    return ImageEpisode(frames, generator.normal(size=(length + 1, 3)), action, embodiment)


def write(folder, embodiment, count=2, first=0):
    actions = get_task("scooping").action_names if embodiment == "robot" else ()
    writer = ImageEpisodeWriter(
        folder, fps=10, state_names="xyz", action_names=actions, embodiment=embodiment, task="scoop"
    )
    for seed in range(first, first + count):
        writer.add(episode(embodiment, 6 + seed, seed))
    return writer.close()


@pytest.mark.parametrize("embodiment", ["robot", "hand"])
def test_what_is_read_is_what_was_written(tmp_path, embodiment):
    read = read_image_episodes(write(tmp_path / "set", embodiment))
    for seed, found in enumerate(read):
        wanted = episode(embodiment, 6 + seed, seed)
        assert np.array_equal(found.frames, wanted.frames) and found.embodiment == embodiment
        np.testing.assert_allclose(found.state, wanted.state, rtol=1e-6)
        if embodiment == "robot":
            np.testing.assert_allclose(found.action, wanted.action, rtol=1e-6)
        else:
            assert found.action is None


def test_the_reader_of_any_robot_takes_the_numbers_and_skips_the_camera(tmp_path):
    recordings = read_lerobot_recordings(write(tmp_path / "set", "robot"))
    assert recordings.state_names == ("x", "y", "z") and recordings.control_hz == 10
    assert list(recordings.skipped) == ["observation.images.third_person"]


def test_labels_of_a_mixed_data_set_are_the_robot_s(tmp_path):
    sources = [Source(write(tmp_path / who, who)) for who in ("robot", "hand")]
    folder = embed_demonstrations(tmp_path / "both", sources, Mean(), mixed=True)
    data, about = load_ted(folder / "ted", task="scooping"), read_about(folder / "ted")
    assert about["notes"]["embodiments"] == ["robot", "robot", "hand", "hand"]
    assert about["lengths"] == [6, 7, 6, 7] and about["labelled_steps"] == 13
    assert data["has_action"][:13].all() and not data["has_action"][13:].any()
    first = torch.from_numpy(episode("robot").frames).float().mean((1, 2))
    torch.testing.assert_close(data["observation"][:6, :3], first[:6])
    assert fit_projection(Mean(), sources, 2).dim == 2


def test_bad_data_sets_are_refused(tmp_path):
    robot, hand = (write(tmp_path / who, who) for who in ("robot", "hand"))
    with pytest.raises(ImageDataError, match="mix the embodiments hand and robot"):
        embed_demonstrations(tmp_path / "out", [Source(robot), Source(hand)], Mean())
    assert not (tmp_path / "out").exists()
    with pytest.raises(ImageDataError, match="holds 2 episodes, asked for 5"):
        Source(robot, 5).read()
    with pytest.raises(ImageDataError, match="embodiment 'hand', wanted 'robot'"):
        Source(hand, embodiment="robot").read()
    with pytest.raises(FileExistsError, match="holds a data set already"):
        write(robot, "robot")
    (robot / "meta" / "info.json").unlink()
    with pytest.raises(ImageDataError, match="no finished data set"):
        Source(robot).read()
