# This source code is licensed under the MIT license found in the LICENSE file.
"""LeRobot data sets of robots that no task describes, with labels for a part of the rows or none."""

from __future__ import annotations

import json

import numpy as np
import pytest

from torchrl_koap.data.d3il.conversion import RawFolderError
from torchrl_koap.data.lerobot.any_robot import read_lerobot_recordings
from torchrl_koap.data.recordings import RecordingsError

pa = pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra lerobot)")
pq = pytest.importorskip("pyarrow.parquet")

JOINTS = [f"joint_{index}" for index in range(7)]
FEATURES = {
    "observation.state": {"dtype": "float32", "shape": [7], "names": {"motors": JOINTS}},
    "observation.force": {"dtype": "float32", "shape": [1], "names": None},
    "observation.images.front": {"dtype": "video", "shape": [48, 64, 3], "names": None},
    "action": {"dtype": "float32", "shape": [7], "names": JOINTS},
}


def write(root, *, actions="all", features=None, rows=6, change=None, version="v3.0", lacking=()):
    """Two episodes of a seven-joint arm; ``actions`` is "all", "none", "missing" or a list of rows without one.

    In format 2.1 every episode has a file of its own; those ``lacking`` have no column of actions.
    """
    state = np.linspace(0, 1, 2 * rows * 7).reshape(-1, 7)
    columns = {
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32())),
        "observation.force": pa.array(np.arange(2.0 * rows)),
        "episode_index": pa.array(np.repeat([0, 1], rows)),
        "frame_index": pa.array(np.tile(np.arange(rows), 2)),
    }
    if actions != "missing":
        gaps = range(2 * rows) if actions == "none" else [] if actions == "all" else actions
        steps = [None if row in gaps else [0.5] * 7 for row in range(2 * rows)]
        columns["action"] = pa.array(steps, pa.list_(pa.float32()))
    columns |= change or {}
    (root / "data/chunk-000").mkdir(parents=True)
    (root / "meta").mkdir()
    table = pa.table(columns)
    if version == "v3.0":
        pq.write_table(table, root / "data/chunk-000/file-000.parquet")
    for episode in range(2) if version == "v2.1" else ():
        part = table.slice(episode * rows, rows)
        part = part.drop_columns(["action"]) if episode in lacking else part
        pq.write_table(part, root / f"data/chunk-000/episode_{episode:06d}.parquet")
    info = {"codebase_version": version, "fps": 30, "total_episodes": 2, "features": features or FEATURES}
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def test_names_rate_and_images(tmp_path):
    recordings = read_lerobot_recordings(write(tmp_path))
    assert recordings.state_names == (*JOINTS, "force") and recordings.action_names == tuple(JOINTS)
    assert recordings.control_hz == 30 and recordings.skipped == ("observation.images.front",)
    assert [frames.shape for frames in recordings.states] == [(6, 8), (6, 8)] and recordings.num_labels == 10


VERSIONS = pytest.mark.parametrize("version", ["v2.1", "v3.0"])


@VERSIONS
def test_actions_for_a_part_of_the_rows(version, tmp_path):
    recordings = read_lerobot_recordings(write(tmp_path, actions=[1, *range(6, 12)], version=version))
    assert recordings.num_labels == 4
    assert np.isnan(recordings.actions[0][1]).all() and np.isnan(recordings.actions[1]).all()


@VERSIONS
@pytest.mark.parametrize("actions", ["none", "missing"])
def test_no_actions_at_all(actions, version, tmp_path):
    recordings = read_lerobot_recordings(write(tmp_path, actions=actions, version=version))
    assert recordings.num_labels == 0 and recordings.actions[0].shape == (5, 7)


@VERSIONS
def test_nan_rows_have_no_label(version, tmp_path):
    steps = np.full((12, 7), 0.5)
    steps[3] = np.nan
    recordings = read_lerobot_recordings(write(tmp_path, change={"action": pa.array(steps.tolist())}, version=version))
    assert recordings.num_labels == 9


def test_an_episode_whose_file_has_no_actions(tmp_path):
    recordings = read_lerobot_recordings(write(tmp_path, version="v2.1", lacking=[1]))
    assert recordings.num_labels == 5 and np.isnan(recordings.actions[1]).all()


@VERSIONS
def test_pictures_inside_the_tables_are_listed_and_skipped(version, tmp_path):
    features = FEATURES | {"observation.images.wrist": {"dtype": "image", "shape": [4, 4, 3], "names": None}}
    pictures = pa.array([{"bytes": b"png", "path": None}] * 12)
    root = write(tmp_path, features=features, change={"observation.images.wrist": pictures}, version=version)
    recordings = read_lerobot_recordings(root)
    assert recordings.skipped == ("observation.images.front", "observation.images.wrist")
    assert recordings.state_names == (*JOINTS, "force")


def test_chosen_features(tmp_path):
    recordings = read_lerobot_recordings(write(tmp_path), features=["observation.force"])
    assert recordings.state_names == ("force",)


def test_faults(tmp_path):
    root = write(tmp_path)
    with pytest.raises(RecordingsError, match="'observation.images.front' is an image .video.: embed it first"):
        read_lerobot_recordings(root, features=["observation.images.front"])
    with pytest.raises(RecordingsError, match="has no feature 'observation.sate'; it has observation.state, "):
        read_lerobot_recordings(root, features=["observation.sate"])
    with pytest.raises(FileNotFoundError, match="no LeRobot data set"):
        read_lerobot_recordings(tmp_path / "none")


def test_states_must_be_whole(tmp_path):
    state = np.ones((12, 7))
    state[5, 2] = np.inf
    with pytest.raises(RawFolderError, match="column 'observation.state' is NaN or infinite in 1 rows, first in row 5"):
        read_lerobot_recordings(write(tmp_path, change={"observation.state": pa.array(state.tolist())}))


def test_a_silent_description_of_missing_actions(tmp_path):
    features = {name: feature for name, feature in FEATURES.items() if name != "action"}
    with pytest.raises(RawFolderError, match="info.json does not say how many columns an action has"):
        read_lerobot_recordings(write(tmp_path, actions="missing", features=features))
