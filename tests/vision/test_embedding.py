# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests camera frames as columns of a data set: choice, fitting, resuming, errors."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from camera_sets import episode, write_filmed
from camera_sets import write_camera_set as write

from torchrl_koap.data import make_recordings, open_dataset, read_recordings, save_demonstrations
from torchrl_koap.data.ted import load_ted, read_about
from torchrl_koap.files import DataError
from torchrl_koap.tasks import get_task
from torchrl_koap.vision import Observer, Projection, backbones, embedding, load_encoder
from torchrl_koap.vision.embedding import embed_recordings, join_recordings, read_sources
from torchrl_koap.vision.encoder import load_cameras

OWN = "tiny_network:random_layer"


def write_own(folder, **options):
    return save_demonstrations(folder / "own", read_recordings(write_filmed(folder / "raw", **options)))


def embed(folder, out, **options):
    recordings, task = read_sources([folder], None)
    return embed_recordings(recordings, task, out, network=OWN, components=5, **options)


def test_embeddings_are_further_columns_that_are_not_the_robot_s(tmp_path):
    own, done = write_own(tmp_path), []
    reports = embed(own, tmp_path / "seen", progress=lambda now, total: done.append((now, total)))
    assert done[-1] == (2 * 240, 2 * 240) and list(reports) == ["top", "wrist"]
    data, task = load_ted(tmp_path / "seen" / "ted")
    before, earlier = load_ted(own / "ted")
    assert task.observation_dim == 2 + 5 + 5 and task.robot == (0, 1) and task.targets == earlier.targets
    assert task.defaults.recovery == 0 and earlier.defaults.recovery is None  # what pictures show is not shifted
    assert task.state_names[2:4] == ("top_0", "top_1") and task.state_names[-1] == "wrist_4"
    assert task.state_units == ("", "") + ("embedding",) * 10  # errors of the joints are measured apart
    assert torch.equal(data["observation"][:, :2], before["observation"])
    assert torch.equal(data["action"], before["action"])
    columns = open_dataset(tmp_path / "seen", task=task)[0]["state"]
    assert columns.shape[1] == 12 and not (tmp_path / "seen" / "unfinished").exists()
    for name, report in reports.items():
        assert report.size == (16, 24) and report.components == 5
        assert 0.3 < report.kept < 1, name
    cameras = load_cameras(tmp_path / "seen" / "cameras")
    frames = np.load(tmp_path / "raw" / "03" / "top.npy")
    wanted = load_encoder(cameras["top"]).embed(torch.from_numpy(frames[:-1]))
    torch.testing.assert_close(data["observation"][data["episode"] == 3][:, 2:7], wanted, rtol=1e-4, atol=1e-5)
    recordings, _ = read_sources([tmp_path / "raw"], task)
    again = embed_recordings(recordings, task, tmp_path / "again", network=OWN, components=9)
    assert [report.components for report in again.values()] == [5, 5]  # of the task


@pytest.mark.parametrize("trajectories", [9, 12])
def test_pictures_unlike_those_of_other_recordings_are_named_if_there_are_ten(tmp_path, trajectories, recwarn):
    raw = write_filmed(tmp_path / "raw", ("top",), trajectories)
    np.save(raw / "07" / "top.npy", np.zeros_like(np.load(raw / "07" / "top.npy")))
    embed(save_demonstrations(tmp_path / "own", read_recordings(raw)), tmp_path / "seen")
    said = [str(each.message) for each in recwarn if "unlike" in str(each.message)]
    assert len(said) == (trajectories >= 10)
    assert all("camera 'top': pictures of 07.npz are unlike those of the others: dark" in each for each in said)


def test_components_are_fitted_to_nine_trajectories_in_ten_and_judged_on_the_others(tmp_path, monkeypatch):
    monkeypatch.setattr(embedding, "MOST", 150)  # of 180 frames: every second one
    recordings, task = read_sources([write_own(tmp_path, cameras=("top",), trajectories=10)], None)
    given = {"network": OWN, "components": 5}
    bare = replace(task, robot=(), state=dict.fromkeys(task.observation_parts, "plain"))
    report = embed_recordings(recordings, bare, tmp_path / "seen", **given)["top"]
    embedded = load_ted(tmp_path / "seen" / "ted")[1]
    assert embedded.robot == (0, 1) and embedded.state_dim == 2 + 5
    fitted = load_cameras(tmp_path / "seen" / "cameras")["top"]
    clips = [torch.from_numpy(np.load(file)) for file in sorted((tmp_path / "raw").glob("*/top.npy"))]
    features = [load_encoder(fitted).features(clip) for clip in clips]
    torch.testing.assert_close(fitted.mean, torch.cat([features[index][index % 2 :: 2] for index in range(9)]).mean(0))
    assert report.kept == pytest.approx(fitted.kept(features[9]))


@pytest.mark.parametrize("offset", [4e6, 1e8])
def test_an_offset_of_the_numbers_beside_frames_is_subtracted_in_float64(offset, tmp_path):
    raw = write_filmed(tmp_path / "raw", cameras=("top",))
    own = save_demonstrations(tmp_path / "near", read_recordings(raw))
    embed(own, tmp_path / "seen")
    near = load_ted(tmp_path / "seen" / "ted")[0]
    for file in raw.glob("*.npz"):
        kept = dict(np.load(file))
        np.savez(file, **kept | {"states": kept["states"] + [offset, 0]})
    embed(save_demonstrations(tmp_path / "own", read_recordings(raw)), tmp_path / "far_seen")
    far, task = load_ted(tmp_path / "far_seen" / "ted")
    origin = torch.tensor(task.observation_origin, dtype=torch.float64)
    assert len(origin) == 7 and origin[1:].count_nonzero() == 0
    back = far["observation"].double() + origin - torch.tensor([offset, 0, 0, 0, 0, 0, 0])
    torch.testing.assert_close(back, near["observation"].double(), atol=1e-5, rtol=1e-4)
    cameras = load_cameras(tmp_path / "far_seen" / "cameras")
    given = {"state": [offset + 0.25, 1.0], "top": np.load(raw / "03" / "top.npy")[4]}
    assert Observer(task, cameras)(given)[0] - offset == 0.25


def test_an_interrupted_embedding_goes_on(tmp_path, monkeypatch):
    own, shown = write_own(tmp_path, cameras=("top",)), []

    def stop(done, total):
        if done > 100:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        embed(own, tmp_path / "seen", progress=stop)
    assert not (tmp_path / "seen" / "ted").exists()
    forward = backbones.Backbone.forward
    monkeypatch.setattr(
        backbones.Backbone, "forward", lambda self, given: shown.append(len(given)) or forward(self, given)
    )
    embed(own, tmp_path / "seen")
    assert 0 < sum(shown) - 2 < 240 - 80  # beside the two black frames that tell the size of maps
    embed(own, tmp_path / "whole")
    (one, _), (other, _) = (load_ted(tmp_path / name / "ted") for name in ("seen", "whole"))
    assert torch.equal(one["observation"], other["observation"])


def test_an_interrupted_embedding_leaves_no_camera_behind(tmp_path):
    own = write_own(tmp_path, cameras=("side", "top"))

    def stop(done, total):
        if done > 2 * total // 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        embed(own, tmp_path / "seen", progress=stop)
    assert load_cameras(tmp_path / "seen" / "cameras").keys() == {"side"}
    embed(own, tmp_path / "seen", cameras=["top"])
    assert load_cameras(tmp_path / "seen" / "cameras").keys() == {"top"}


def test_without_components_there_is_nothing_to_embed_into(tmp_path):
    recordings, task = read_sources([write_own(tmp_path)], None)
    with pytest.raises(ValueError, match=r"components \(--components\) must be at least 1, got 0"):
        embed_recordings(recordings, task, tmp_path / "seen", network=OWN, components=0)
    assert not (tmp_path / "seen").exists()


def test_a_task_with_embeddings_of_its_own_takes_several_sources(tmp_path):
    pytest.importorskip("pyarrow")
    robot, hand = (write(tmp_path / who, who) for who in ("robot", "hand"))
    recordings, task = read_sources([robot, hand], get_task("scooping"))
    components = torch.randn(40, 96, generator=torch.Generator().manual_seed(0))
    fitted = Projection(torch.zeros(40), components, embedder_of(8).identity)
    old = Projection(torch.zeros(144), torch.randn(144, 96), fitted.about)
    with pytest.raises(ValueError, match="fitted on 144 features, got 40"):
        embed_recordings(recordings, task, tmp_path / "old", network=OWN, projection=old)
    embed_recordings(recordings, task, tmp_path / "both", network=OWN, projection=fitted)
    data, about = load_ted(tmp_path / "both" / "ted")[0], read_about(tmp_path / "both" / "ted")
    assert about["lengths"] == [6, 7, 6, 7] and about["labelled_steps"] == 13 and about["task"] == "scooping"
    assert data["has_action"][:13].all() and not data["has_action"][13:].any()
    wanted = load_encoder(tmp_path / "both" / "cameras" / "third_person.safetensors")
    frames, states, _ = (torch.from_numpy(part) for part in episode("robot"))
    torch.testing.assert_close(data["observation"][:6, :96], wanted.embed(frames)[:6], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(data["observation"][:6, 96:], states[:6], rtol=1e-6)


@pytest.mark.parametrize(
    ("rate", "names", "fault"),
    [
        (30.0, ["x", "y"], "the source of b cannot be used: it has 30 frames per second, the first 10: convert"),
        (8.0, ["x", "y"], "the source of b cannot be used: it has 8 frames per second, the first 10: convert"),
        (10.0, ["y", "x"], "the source of b cannot be used: its actions are y, x; those of the first x, y"),
    ],
)
def test_sources_of_another_rate_or_with_other_actions_are_refused(rate, names, fault):
    def recorded(source, **about):
        return make_recordings([np.zeros((3, 1))], [np.ones((2, 2))], sources=[source], **about)

    first = recorded("a", control_hz=10.0, action_names=["x", "y"])
    assert len(join_recordings([first, replace(first, control_hz=11.0)]).states) == 2
    with pytest.raises(DataError, match=fault):
        join_recordings([first, recorded("b", control_hz=rate, action_names=names)])


def test_joined_sources_have_the_cameras_of_all(tmp_path):
    sets = {"both": ("top", "wrist"), "one": ("wrist",)}
    parts = [read_recordings(write_filmed(tmp_path / name, cameras, 2)) for name, cameras in sets.items()]
    assert {name: len(clips) for name, clips in join_recordings(parts).cameras.items()} == {"wrist": 4}


def embedder_of(size):
    from torchrl_koap.vision import FrozenImageEncoder, load_backbone

    return FrozenImageEncoder(load_backbone(OWN), size=size)


def test_bad_data_are_refused_by_camera_trajectory_and_frame(tmp_path):
    own = write_own(tmp_path)
    file = tmp_path / "raw" / "07" / "top.npy"
    np.save(file, np.load(file)[:, :8])
    with pytest.raises(DataError, match=r"camera 'top' of 07.npz cannot be used: frame 0 is 8 x 24, .* others are 16"):
        embed(own, tmp_path / "seen")
    assert not (tmp_path / "seen" / "ted").exists()
    with pytest.raises(ValueError, match="unknown camera 'tip'; did you mean 'top'"):
        embed(own, tmp_path / "seen", cameras=["tip"])
    with pytest.raises(ValueError, match="a projection fits one camera, got 2"):
        embed(own, tmp_path / "seen", projection=Projection(torch.zeros(4), torch.zeros(4, 2)))
    with pytest.raises(DataError, match="`koap convert` it, or name its --task"):
        read_sources([tmp_path / "raw"], None)
    plain = save_demonstrations(tmp_path / "plain", [np.random.rand(9, 2)], control_hz=10, action_dim=1)
    with pytest.raises(DataError, match="there are no cameras"):
        embed(plain, tmp_path / "seen")
    with pytest.raises(DataError, match="its columns are state_0, state_1, state_2"):
        other = save_demonstrations(tmp_path / "other", [np.random.rand(9, 3)], control_hz=10, action_dim=2)
        read_sources([own, other], None)


def test_sources_of_other_units_or_kinds_of_actions_are_refused(tmp_path):
    def stored(name, **described):
        steps = [np.eye(9)[:8, :2]] if "action_kind" in described else None
        how = {"control_hz": 10, "action_dim": 2} | described
        return save_demonstrations(tmp_path / name, [np.random.default_rng(0).normal(size=(9, 2))], steps, **how)

    first = stored("first", state_units="rad", action_kind="delta")
    assert len(read_sources([first, stored("bare"), stored("same", state_units="rad")], None)[0].states) == 3
    unknown = stored("unknown", action_kind="raw"), stored("hand")  # without labels, its kind of actions says nothing
    assert len(read_sources(unknown, None)[0].states) == 2
    with pytest.raises(DataError, match="the unit of column 'state_0' is 'deg', before 'rad'"):
        read_sources([first, stored("between"), stored("turned", state_units="deg")], None)
    with pytest.raises(DataError, match="the kind of action 'action_0' is 'raw', before 'delta'"):
        read_sources([first, stored("kind", action_kind="raw")], None)


def test_a_network_of_new_weights_each_time_is_refused_before_it_embeds(tmp_path):
    (tmp_path / "net.py").write_text("import torch\n\n\ndef make():\n    return torch.nn.Conv2d(3, 4, 3)\n")
    recordings, task = read_sources([write_own(tmp_path)], None)
    with pytest.raises(ValueError, match="net.py:make' has other weights each time it is made: load them"):
        embed_recordings(recordings, task, tmp_path / "seen", network=f"{tmp_path / 'net.py'}:make")
    assert not (tmp_path / "seen").exists()


def test_actions_are_those_of_the_first_source_with_labels(tmp_path):
    states = np.random.default_rng(0).normal(size=(9, 2))

    def stored(name, steps, names, *targets):
        how = {"action_kind": "absolute", "targets": targets} if targets else {}
        how |= {"control_hz": 10, "state_names": ["x", "y"], "action_names": names}
        return save_demonstrations(tmp_path / name, [states], steps, **how)

    hand = stored("hand", None, ["a", "b"])
    robot = stored("robot", [states[1:]], ["to_x", "to_y"], "x", "y")
    recordings, task = read_sources([hand, robot], None)
    assert recordings.action_names == task.action_names == ("to_x", "to_y") and task.name == "robot"
    assert [(action.kind, action.column) for action in task.actions.values()] == [("absolute", 0), ("absolute", 1)]
    assert [np.isnan(steps).all() for steps in recordings.actions] == [True, False]
    with pytest.raises(DataError, match="the target of action 'to_x' is 'y', before 'x'"):
        read_sources([robot, stored("turned", [states[1:]], ["to_x", "to_y"], "y", "x")], None)
    with pytest.raises(DataError, match="its actions are other, to_y; those of the first to_x, to_y"):
        read_sources([hand, robot, stored("other", [states[1:]], ["other", "to_y"], "x", "y")], None)
