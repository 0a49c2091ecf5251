# This source code is licensed under the MIT license found in the LICENSE file.
"""Camera demonstrations as embeddings: labels are the robot's, and embodiments do not mix by accident."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("pyarrow")
from camera_sets import episode
from camera_sets import write_camera_set as write

from torchrl_koap.data import load_ted, read_about
from torchrl_koap.files import DataError
from torchrl_koap.tasks import get_task
from torchrl_koap.vision.demonstrations import Source, embed_demonstrations, fit_projection


class Mean:
    """Stands for an encoder: the mean colour, repeated."""

    identity = {"weights": "none"}

    def embed(self, frames):
        return frames.float().mean((1, 2)).repeat(1, get_task("scooping").state_dim // 3)

    def features(self, frames):
        return frames.float().mean((1, 2))


def test_labels_of_a_mixed_data_set_are_the_robot_s(tmp_path):
    sources = [Source(write(tmp_path / who, who)) for who in ("robot", "hand")]
    folder = embed_demonstrations(tmp_path / "both", sources, Mean(), mixed=True)
    data, about = load_ted(folder / "ted")[0], read_about(folder / "ted")
    assert about["notes"]["embodiments"] == ["robot", "robot", "hand", "hand"]
    assert about["lengths"] == [6, 7, 6, 7] and about["labelled_steps"] == 13
    assert data["has_action"][:13].all() and not data["has_action"][13:].any()
    first = torch.from_numpy(episode("robot").frames).float().mean((1, 2))
    torch.testing.assert_close(data["observation"][:6, :3], first[:6])
    assert fit_projection(Mean(), sources, 2).dim == 2


def test_bad_data_sets_are_refused(tmp_path):
    robot, hand = (write(tmp_path / who, who) for who in ("robot", "hand"))
    with pytest.raises(DataError, match="mix the embodiments hand and robot"):
        embed_demonstrations(tmp_path / "out", [Source(robot), Source(hand)], Mean())
    assert not (tmp_path / "out").exists()
