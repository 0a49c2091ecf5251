# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests LeRobot data sets of unregistered robots, with labels for some rows or none."""

import importlib.util
import io
import json

import numpy as np
import pytest
from PIL import Image

from torchrl_koap.data.formats.lerobot import read_lerobot
from torchrl_koap.files import DataError

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
    """Two episodes of a seven-joint arm; ``actions`` is "all", "none", "missing" or a list of rows without one."""
    state = np.linspace(0, 1, 2 * rows * 7).reshape(-1, 7)
    columns = {
        "observation.state": pa.array(state.tolist(), pa.list_(pa.float32(), 7)),
        "observation.force": pa.array([[row] for row in range(2 * rows)], pa.large_list(pa.int16())),
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
    recordings = read_lerobot(write(tmp_path))
    assert recordings.state_names == (*JOINTS, "force") and recordings.action_names == tuple(JOINTS)
    assert recordings.control_hz == 30 and recordings.skipped == ("observation.images.front (its videos are not here)",)
    assert [frames.shape for frames in recordings.states] == [(6, 8), (6, 8)] and recordings.num_labels == 10


@pytest.mark.parametrize("feature", ["observation.state", "action"])
def test_columns_whose_names_repeat_are_numbered(feature, tmp_path):
    names = ["gripper", *JOINTS[:5], "gripper"]  # of two arms
    recordings = read_lerobot(write(tmp_path, features=FEATURES | {feature: {**FEATURES[feature], "names": names}}))
    found = recordings.action_names if feature == "action" else recordings.state_names[:7]
    assert found == tuple(f"{feature.removeprefix('observation.')}_{index}" for index in range(7))
    assert [steps.shape for steps in recordings.actions] == [(5, 7), (5, 7)]


VERSIONS = pytest.mark.parametrize("version", ["v2.1", "v3.0"])


def test_names_in_several_groups(tmp_path):
    arms = {"left": [f"left_{joint}" for joint in JOINTS[:4]], "right": [f"right_{joint}" for joint in JOINTS[:3]]}
    features = FEATURES | {"observation.state": {**FEATURES["observation.state"], "names": arms}}
    assert read_lerobot(write(tmp_path, features=features)).state_names[:7] == (*arms["left"], *arms["right"])


def test_names_with_the_numbers_of_their_columns(tmp_path):
    numbers = {joint: number for number, joint in reversed([*enumerate(JOINTS)])}
    features = FEATURES | {"observation.state": {**FEATURES["observation.state"], "names": numbers}}
    assert read_lerobot(write(tmp_path, features=features)).state_names[:7] == tuple(JOINTS)


def test_rows_in_any_order_are_sorted(tmp_path):
    wanted, root = read_lerobot(write(tmp_path / "a")), write(tmp_path / "b")
    file = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(file).take(np.random.default_rng(0).permutation(12)), file)
    np.testing.assert_array_equal(read_lerobot(root).states, wanted.states)


@pytest.mark.parametrize(
    "given", [{"x": None}, [*JOINTS, JOINTS[0]], {name: None if name == JOINTS[3] else 1 for name in JOINTS}]
)
def test_names_without_numbers_are_not_used(given, tmp_path):
    features = FEATURES | {"observation.state": {**FEATURES["observation.state"], "names": given}}
    assert read_lerobot(write(tmp_path, features=features)).state_names[:2] == ("state_0", "state_1")


def test_a_state_column_is_not_replaced_by_a_column_of_the_data_set_of_its_name(tmp_path):
    features = FEATURES | {"observation.state": {**FEATURES["observation.state"], "names": ["timestamp", *JOINTS[1:]]}}
    stamps = {"timestamp": pa.array(np.tile(np.arange(6) / 30, 2))}
    recordings = read_lerobot(write(tmp_path, features=features, change=stamps))
    assert recordings.state_names == (*(f"state_{index}" for index in range(7)), "force")
    np.testing.assert_allclose(recordings.states[0][:, 0], np.linspace(0, 1, 84)[:42:7], rtol=1e-6)


def test_features_whose_columns_have_one_name_are_refused(tmp_path):
    features = FEATURES | {"observation.state_1": FEATURES["observation.force"]}
    features["observation.state"] = {**FEATURES["observation.state"], "names": None}
    more = {"observation.state_1": pa.array(np.zeros(12))}
    with pytest.raises(DataError, match="two features have a column state_1: name those to read in observations"):
        read_lerobot(write(tmp_path, features=features, change=more))


@VERSIONS
def test_actions_for_a_part_of_the_rows(version, tmp_path):
    recordings = read_lerobot(write(tmp_path, actions=[1, *range(6, 12)], version=version))
    assert recordings.num_labels == 4
    assert np.isnan(recordings.actions[0][1]).all() and np.isnan(recordings.actions[1]).all()


@VERSIONS
@pytest.mark.parametrize("actions", ["none", "missing"])
def test_no_actions_at_all(actions, version, tmp_path):
    recordings = read_lerobot(write(tmp_path, actions=actions, version=version))
    assert recordings.num_labels == 0 and recordings.actions[0].shape == (5, 7)


def test_an_episode_whose_file_has_no_actions(tmp_path):
    recordings = read_lerobot(write(tmp_path, version="v2.1", lacking=[1]))
    assert recordings.num_labels == 5 and np.isnan(recordings.actions[1]).all()


@VERSIONS
def test_pictures_inside_the_tables_are_referred_to(version, tmp_path):
    features = FEATURES | {"observation.images.wrist": {"dtype": "image", "shape": [4, 4, 3], "names": None}}
    pictures = [io.BytesIO() for _ in range(12)]
    for row, picture in enumerate(pictures):
        Image.new("RGB", (4, 4), (row, 0, 0)).save(picture, "png")
    pictures = pa.array([{"bytes": picture.getvalue(), "path": None} for picture in pictures])
    root = write(tmp_path, features=features, change={"observation.images.wrist": pictures}, version=version)
    recordings = read_lerobot(root)
    assert recordings.skipped == ("observation.images.front (its videos are not here)",)
    seen = [[frame[0, 0, 0] for frame in clip.read()] for clip in recordings.cameras["wrist"]]
    assert seen == [[*range(6)], [*range(6, 12)]]
    assert recordings.state_names == (*JOINTS, "force")


def test_a_feature_of_text_is_listed(tmp_path):
    features = FEATURES | {"observation.task": {"dtype": "string", "shape": [1], "names": None}}
    recordings = read_lerobot(write(tmp_path, features=features, change={"observation.task": pa.array(["go"] * 12)}))
    assert recordings.state_names == (*JOINTS, "force") and "observation.task" in recordings.skipped


def test_chosen_features(tmp_path):
    recordings = read_lerobot(write(tmp_path), observations=["observation.force"])
    assert recordings.state_names == ("force",)


def test_faults(tmp_path):
    root = write(tmp_path)
    with pytest.raises(DataError, match="'observation.images.front' is an image .video. and cannot be part of the"):
        read_lerobot(root, observations=["observation.images.front"])
    with pytest.raises(DataError, match="has no feature 'observation.sate'; it has observation.state, "):
        read_lerobot(root, observations=["observation.sate"])


def test_features_of_other_names_and_shapes(tmp_path):
    matrix = {"dtype": "float32", "shape": [2, 2], "names": None}
    with pytest.raises(DataError, match=r"'observation.turn' has shape \[2, 2\] and cannot be part of the state"):
        read_lerobot(
            write(tmp_path / "a", features=FEATURES | {"observation.turn": matrix}), observations=["observation.turn"]
        )
    features = {"state": FEATURES["observation.state"], "actions": FEATURES["action"]}
    with pytest.raises(DataError, match=r"name those of the state in observations .*; there are state, actions"):
        read_lerobot(write(tmp_path / "b", features=features))


def test_a_data_set_without_rows(tmp_path):
    root = write(tmp_path)
    info = json.loads((root / "meta/info.json").read_text())
    (root / "meta/info.json").write_text(json.dumps(info | {"total_episodes": 0}))
    file = root / "data/chunk-000/file-000.parquet"
    pq.write_table(pq.read_table(file).slice(0, 0), file)
    with pytest.raises(DataError, match="there are no trajectories"):
        read_lerobot(root)


def test_a_damaged_name_of_a_column(tmp_path):
    root = write(tmp_path, change={"zzzz": pa.array(np.arange(12))})
    file = root / "data/chunk-000/file-000.parquet"
    file.write_bytes(file.read_bytes().replace(b"zzzz", b"\xe3zzz"))
    with pytest.raises(DataError, match="file-000.parquet: it is no parquet file, or damaged"):
        read_lerobot(root)


def test_hidden_files_are_not_read(tmp_path):
    root = write(tmp_path)
    (root / "data/chunk-000/._file-000.parquet").write_bytes(b"of a file manager")
    assert len(read_lerobot(root).states) == 2


def test_a_silent_description_of_missing_actions(tmp_path):
    features = {name: feature for name, feature in FEATURES.items() if name != "action"}
    with pytest.raises(DataError, match="info.json does not give the number of action columns"):
        read_lerobot(write(tmp_path, actions="missing", features=features))


def edited(name, edit):
    def change(table):
        rows, position = table[name].to_pylist(), table.column_names.index(name)
        return table.set_column(position, name, pa.array(edit(rows)))

    return change


def put(row, value):
    return lambda rows: [*rows[:row], value(rows[row]) if callable(value) else value, *rows[row + 1 :]]


FILES = [
    (lambda t: t.drop_columns("observation.state"), "FILE: missing column 'observation.state'; it has observ"),
    (edited("observation.state", put(3, None)), "trajectory episode 1: states are not finite, first at frame 3"),
    (edited("action", put(5, lambda row: row[:1])), "FILE: column 'action' has rows of 1 and 7 numbers"),
    (edited("action", lambda rows: ["up"] * len(rows)), "FILE: column 'action' must hold numbers or lists of numbers"),
    (edited("action", lambda rows: [1.0] * len(rows)), "FILE: column 'action' holds double, but list"),
    (lambda t: t.slice(0, 0), "1 episodes are missing: 1"),
    (lambda t: pa.concat_tables([t, t.slice(5)]), "FILE: episode 1 has 7 rows, its description says 6"),
    (lambda t: t.slice(0, 4), "FILE: episode 1 has 4 rows, its description says 6"),
    (edited("frame_index", put(5, 9)), "FILE: column 'frame_index' of episode 1 must count 0, 1, 2, ..."),
    (edited("observation.state", lambda rows: [row[:3] for row in rows]), "'observation.state' has rows of 3 and 7"),
    (edited("episode_index", put(3, None)), "FILE: column 'episode_index' must hold whole numbers, got an empty row"),
    (edited("episode_index", put(0, 1.5)), "FILE: column 'episode_index' must hold whole numbers, got 1.5"),
    (lambda t: t.append_column("action", t["action"]), "FILE: two columns are named action"),
]


@pytest.mark.parametrize(("change", "problem"), FILES)
def test_faults_name_file_and_column(change, problem, tmp_path):
    root = write(tmp_path, version="v2.1")
    lines = [json.dumps({"episode_index": number, "length": 6}) for number in range(2)]
    (root / "meta/episodes.jsonl").write_text("\n".join(lines))
    file = root / "data/chunk-000/episode_000001.parquet"
    pq.write_table(change(pq.read_table(file)), file)
    with pytest.raises(DataError) as caught:
        read_lerobot(root)
    (found,) = caught.value.problems
    assert problem.replace("FILE", str(file)) in found


def test_actions_that_are_announced_and_absent_are_told(tmp_path):
    assert "action (info.json lists it, no file has it)" in read_lerobot(write(tmp_path, actions="missing")).skipped
    with pytest.raises(DataError, match="action_names has 7 names for 3 columns"):
        read_lerobot(tmp_path, action_dim=3)


def test_missing_episodes_are_told(tmp_path):
    root = write(tmp_path, version="v2.1")
    (root / "data/chunk-000/episode_000000.parquet").unlink()
    with pytest.raises(DataError, match=r"1 episodes are missing: 0; name in episodes .*those to read: 1"):
        read_lerobot(root)
    assert read_lerobot(root, episodes=[1]).sources == ("episode 1",)
    with pytest.raises(DataError, match="1 episodes are missing: 5"):
        read_lerobot(root, episodes=[1, 5])
    listed = pa.table({"episode_index": [1, 7], "length": [6, 6]})
    (root / "meta/episodes/chunk-000").mkdir(parents=True)
    pq.write_table(listed, root / "meta/episodes/chunk-000/file-000.parquet")
    with pytest.raises(DataError, match="1 episodes are missing: 7"):
        read_lerobot(root)


def test_rows_of_an_episode_that_is_not_described_are_told(tmp_path):
    root = write(tmp_path, version="v2.1")
    (root / "meta/episodes.jsonl").write_text('{"episode_index": 0, "length": 6}\n')
    with pytest.raises(DataError, match="the description of episodes lacks 1, which have rows: name in episod"):
        read_lerobot(root)
    assert read_lerobot(root, episodes=[1]).sources == ("episode 1",)


def test_columns_that_are_not_described_are_listed(tmp_path):
    added = {"observation.touch": pa.array(np.arange(12.0)), "next.done": pa.array(np.arange(12) % 3 == 2)}
    said = ["observation.touch (info.json does not list it)", "next.done (info.json does not list it)"]
    assert list(read_lerobot(write(tmp_path, change=added)).skipped)[-2:] == said


def test_several_tasks_are_told(tmp_path):
    info = write(tmp_path) / "meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"total_tasks": 3}))
    assert read_lerobot(tmp_path).skipped[-1].startswith("task_index (3 tasks become one: name the episodes")


def test_flags_inside_an_episode_end_it(tmp_path):
    flagged = {"next.done": pa.array(np.arange(12) % 3 == 2)}
    root = write(tmp_path, change=flagged, features=FEATURES | {"next.done": {"dtype": "bool", "shape": [1]}})
    assert [len(frames) for frames in read_lerobot(root).states] == [3] * 4


def test_another_width_than_described_is_told(tmp_path):
    features = FEATURES | {"observation.state": {"dtype": "float32", "shape": [6], "names": JOINTS[:6]}}
    with pytest.raises(DataError, match="column 'observation.state' has 7 numbers, info.json says 6"):
        read_lerobot(write(tmp_path, features=features))


def test_invalid_descriptions(tmp_path):
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text(json.dumps({"features": FEATURES}))
    with pytest.raises(FileNotFoundError, match=r"no \*\.parquet below"):
        read_lerobot(tmp_path)
    root = write(tmp_path / "set")
    for text, message in (
        ("{", "info.json cannot be used: it cannot be read as JSON"),
        ("[1]", "must hold an object, got list"),
        ('{"codebase_version": "v4.0"}', "info.json cannot be used: its codebase_version is v4.0, wanted 2.x or 3.x"),
    ):
        (root / "meta/info.json").write_text(text)
        with pytest.raises(DataError, match=message):
            read_lerobot(root)
    shaped = FEATURES | {"action": {"dtype": "float32", "shape": 7}}
    for change, message in (
        ({"features": shaped}, "info.json cannot be used: 'shape' of action must be a list of numbers"),
        ({"video_path": "{camera}/{file_index}.mp4"}, "info.json: 'video_path' has an unknown part: 'camera'"),
        *(({"fps": fps}, "info.json holds no fps: pass control_hz") for fps in (float("inf"), 0)),
    ):
        described = {"codebase_version": "v3.0", "fps": 30, "total_episodes": 2, "features": FEATURES} | change
        (root / "meta/info.json").write_text(json.dumps(described))
        with pytest.raises(DataError, match=message):
            read_lerobot(root)
    root = write(tmp_path / "other")
    (root / "meta/episodes.jsonl").write_text('{"episode_index": 0}')
    with pytest.raises(DataError, match="list of its episodes cannot be read"):
        read_lerobot(root)


def test_without_pyarrow_the_extra_is_named(tmp_path, monkeypatch):
    root, find_spec = write(tmp_path), importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pyarrow" else find_spec(name))
    with pytest.raises(RuntimeError, match=r"pip install 'torchrl_koap\[lerobot\]'"):
        read_lerobot(root)


def test_columns_of_the_surroundings_are_told_by_their_names(tmp_path):
    named = {"dtype": "float32", "shape": [1], "names": {"keypoints": ["x"]}}
    features = {("observation.environment_state" if "force" in key else key): value for key, value in FEATURES.items()}
    features["observation.environment_state"] = named
    change = {"observation.environment_state": pa.array(np.arange(12.0))}
    recordings = read_lerobot(write(tmp_path, features=features, change=change))
    assert recordings.state_names == (*JOINTS, "environment_state_x")
