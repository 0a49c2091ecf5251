# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the files of a written LeRobot data set; the readers' tests read it back."""

import json

import numpy as np
import pytest

pq = pytest.importorskip("pyarrow.parquet")

from torchrl_koap.data import make_recordings, read_recordings  # noqa: E402
from torchrl_koap.data.formats.writers import LeRobotWriter, write_lerobot, write_npz  # noqa: E402


def test_a_data_set_of_format_3(tmp_path):
    writer = LeRobotWriter(
        tmp_path, fps=12.5, state_names=["x", "y"], action_names=["dx"], embodiment="robot", task="go"
    )
    for length in (4, 6):
        writer.add(np.ones((length, 2)), np.arange(length - 1.0)[:, None])
    writer.close()
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 12.5 and info["robot_type"] == "robot"
    assert info["total_episodes"] == 2 and info["total_frames"] == 10 and info["splits"] == {"train": "0:2"}
    assert info["features"]["observation.state"] == {"dtype": "float32", "shape": [2], "names": ["x", "y"]}
    listed = pq.read_table(tmp_path / "meta/episodes/chunk-000/file-000.parquet").to_pydict()
    assert listed["length"] == [4, 6] and listed["dataset_to_index"] == [4, 10] and listed["tasks"] == [["go"]] * 2
    tasks = pq.read_table(tmp_path / "meta/tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0], "task": ["go"]}
    assert tasks.schema.pandas_metadata["index_columns"] == ["task"]  # LeRobot takes a task's text from this index
    for number, file in enumerate(listed["data/file_index"]):
        place = info["data_path"].format(chunk_index=listed["data/chunk_index"][number], file_index=file)
        rows = pq.read_table(tmp_path / place).to_pydict()
        assert rows["episode_index"] == [number] * listed["length"][number]
        assert rows["index"][0] == listed["dataset_from_index"][number]
        assert rows["action"][-1] == rows["action"][-2]  # nothing was done behind the last frame
    assert rows["timestamp"][:3] == pytest.approx([0.0, 0.08, 0.16])


@pytest.mark.parametrize(("offset", "dtype"), [((0, 0), "float32"), ((4e6, 0), "float64"), ((0, 4e6), "float64")])
def test_numbers_that_float32_rounds_coarsely_are_written_in_float64(tmp_path, offset, dtype):
    states = [np.linspace(0, 1, 20).reshape(10, 2) + offset[0]]
    actions = np.where(np.arange(9)[:, None] == 4, np.nan, states[0][1:, :1] - offset[0] + offset[1])
    recordings = make_recordings(states, [actions], control_hz=30.0)
    write_lerobot(recordings, tmp_path / "arm")
    info = json.loads((tmp_path / "arm/meta/info.json").read_text())
    assert info["features"]["observation.state"]["dtype"] == dtype
    found = read_recordings(tmp_path / "arm")
    np.testing.assert_allclose(found.states[0], states[0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.actions[0], actions, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("source", "file"), [(None, "trajectory_03"), ("b/{}.csv[1]", "trajectory_03_b_7_csv_1")])
def test_archives_are_read_in_the_order_in_which_they_were_written(source, file, tmp_path):
    states = [np.full((2, 1), number) for number in range(11)]
    names = None if source is None else [source.format(10 - number) for number in range(11)]
    write_npz(make_recordings(states, action_dim=1, control_hz=30.0, sources=names), tmp_path / "arm")
    np.testing.assert_array_equal(read_recordings(tmp_path / "arm").states, states)
    assert (tmp_path / f"arm/{file}.npz").exists()
