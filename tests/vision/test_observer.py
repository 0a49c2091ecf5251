# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests observations from a robot's numbers and frames: order of columns, and errors."""

import numpy as np
import pytest
import torch

from torchrl_koap.tasks import Action, Task
from torchrl_koap.vision import FrozenImageEncoder, Observer, Projection, load_backbone, load_encoder

OWN = "tiny_network:random_layer"
FRAME = np.random.default_rng(0).integers(0, 256, (16, 24, 3), dtype=np.uint8)


def make(hidden=()):
    parts = {"top": 3, "joints": 2, "wrist": 4, "cup": ("x", "y")}
    task = Task(name="arm", observation_parts=parts, actions={"a": Action("m")}, position="cup", hidden=hidden)
    about = FrozenImageEncoder(load_backbone(OWN), size=(16, 24)).identity
    cameras = {
        name: Projection(torch.zeros(40), torch.randn(40, width), about)
        for name, width in {"top": 3, "wrist": 4}.items()
    }
    return Observer(task, cameras), cameras


def test_columns_are_those_of_the_task():
    observe, cameras = make()
    seen = observe({"wrist": FRAME[::-1], "state": [1.0, 2.0, 3.0, 4.0], "top": FRAME})
    assert seen.shape == (11,) and seen[[3, 4, 9, 10]].tolist() == [1, 2, 3, 4]
    for name, columns, frame in (("top", slice(0, 3), FRAME), ("wrist", slice(5, 9), FRAME[::-1].copy())):
        torch.testing.assert_close(seen[columns].float(), load_encoder(cameras[name]).embed(torch.from_numpy(frame)))
    several = {name: np.stack([frame] * 2) for name, frame in {"top": FRAME, "wrist": FRAME[::-1]}.items()}
    torch.testing.assert_close(observe({"state": np.array([[1.0, 2, 3, 4]] * 2), **several})[1], seen)
    assert observe(observe.example()).shape == (11,) and observe.example()["top"].shape == (16, 24, 3)


def test_masked_numbers_with_frames_become_nan():
    observe, _ = make()
    masked = np.ma.masked_array([1.0, 2.0, 3.0, 4.0], mask=[0, 1, 0, 0])
    seen = observe({"wrist": FRAME, "top": FRAME, "state": masked})[[3, 4, 9, 10]]
    assert seen.isnan().tolist() == [False, True, False, False]
    with pytest.raises(ValueError, match="an observation must be numbers .*, got list"):
        observe({"wrist": FRAME, "top": FRAME, "state": ["left"] * 4})


def test_numbers_that_no_policy_sees_may_be_left_out():
    observe, _ = make(hidden=("joints", "cup"))
    assert observe({"top": FRAME, "wrist": FRAME})[3:5].tolist() == [0, 0]
    with pytest.raises(ValueError, match="has no 'state': wanted state, top, wrist, got top, wrist"):
        make()[0]({"top": FRAME, "wrist": FRAME})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"wrst": FRAME}, "has an unknown 'wrst': wanted state, top, wrist"),
        ({"state": np.zeros(3)}, r"'state' must be \[4\] with these frames, got \[3\]"),
        ({"top": FRAME[..., :1]}, "the frame of camera 'top' has shape"),
    ],
)
def test_other_entries_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        make()[0]({"state": np.zeros(4), "top": FRAME, "wrist": FRAME} | change)


def test_a_camera_needs_its_part_of_the_task():
    observe, cameras = make()
    task = Task(name="arm", observation_parts={"top": 3, "x": 1}, actions={"a": Action("m")}, position="x")
    with pytest.raises(ValueError, match="camera 'wrist' has embeddings of 4 columns, task 'arm' has none"):
        Observer(task, cameras)
    with pytest.raises(ValueError, match="camera 'top' has embeddings of 4 columns, task 'arm' has 3 for that name"):
        Observer(task, {"top": cameras["wrist"]})


def test_networks_are_loaded_before_the_first_frame(monkeypatch):
    observe, cameras = make()
    task = Task(name="arm", observation_parts={"wrist": 4}, actions={"a": Action("m")}, position="wrist")
    monkeypatch.setattr("torchrl_koap.vision.observer.load_encoder", pytest.fail)
    assert observe(observe.example()).shape == (11,)
    monkeypatch.undo()
    cameras["wrist"].about["network"] = "/nowhere/net.py:network"
    with pytest.raises(ValueError, match="^network: module '/nowhere/net.py' cannot be"):
        Observer(task, {"wrist": cameras["wrist"]})
