# This source code is licensed under the MIT license found in the LICENSE file.
"""What does not fit in a LeRobot folder is named, with file and column."""

from __future__ import annotations

import importlib.util

import pytest
import torch
from lerobot_sets import VERSIONS, made_up, with_column, write_lerobot

from torchrl_koap.data import D3ILExperienceReplay, RawFolderError, read_lerobot
from torchrl_koap.data.lerobot.files import is_lerobot
from torchrl_koap.data.lerobot.reader import column_names
from torchrl_koap.tasks import get_task

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra lerobot)")
import pyarrow as pa  # noqa: E402
import pyarrow.compute  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402


def test_widths_that_are_not_the_tasks(tmp_path, recorded):
    root = write_lerobot(tmp_path / "set", recorded)
    with pytest.raises(ValueError, match=r"4 columns, task 'sorting_2' has 10: desired_xy \(2\).*columns: avoiding"):
        read_lerobot(root, "sorting_2")
    # D3IL's own layout of Stacking lacks the measured joints
    data = made_up("stacking")
    change = with_column("observation.state", lambda rows: [row[:20] for row in rows])
    root = write_lerobot(tmp_path / "stacking", data, change=change)
    with pytest.raises(ValueError, match=r"20 columns, task 'stacking' has 31: .*measured_joints \(7\)"):
        read_lerobot(root, "stacking")
    names = column_names(get_task("stacking"))[:20]
    root = write_lerobot(tmp_path / "named", data, names=names, change=change)
    with pytest.raises(ValueError, match="columns missing for task 'stacking': measured_joints_0, .*tcp_position_2"):
        read_lerobot(root, "stacking")
    change = with_column("action", lambda rows: [[*row, 0.0] for row in rows])
    with pytest.raises(RawFolderError, match="column 'action' has 3 entries, task 'avoiding' has 2"):
        read_lerobot(write_lerobot(tmp_path / "wide", recorded, change=change), "avoiding")


def edited(name, row, value):
    def edit(rows):
        rows[row] = value(rows[row])
        return rows

    return with_column(name, edit)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda c: c.drop_columns("action"), "missing column 'action'; the file has observation.state, episode_index"),
        (
            edited("observation.state", 3, lambda row: [float("nan"), *row[1:]]),
            "column 'observation.state' is NaN or infinite in 1 rows, first in row 3",
        ),
        (edited("action", 5, lambda row: [float("inf"), 0.0]), "column 'action' is NaN or infinite in 1 rows, first"),
        (edited("action", 5, lambda row: None), "column 'action' has empty entries"),
        (edited("action", 5, lambda row: [None, 0.0]), "column 'action' has empty entries"),
        (edited("action", 5, lambda row: [0.0]), "column 'action' has rows of 1 and 2 numbers"),
        (with_column("action", lambda rows: ["up" for _ in rows]), "column 'action' must hold numbers"),
        (lambda c: c.slice(0, 0), "column 'observation.state' has no rows"),
        (lambda c: c.slice(0, 9), "episode 1 has 9 rows, its description says"),
        (
            with_column("frame_index", lambda rows: [row + 1 for row in rows]),
            "column 'frame_index' of episode 1 must count 0, 1, 2, ...",
        ),
        (
            with_column("observation.state", lambda rows: [row[:3] for row in rows]),
            "its columns have widths {'observation.state': 3, 'action': 2}, those of episode_000000.parquet",
        ),
    ],
)
def test_faults_name_file_and_column(tmp_path, recorded, change, problem):
    root = write_lerobot(tmp_path, recorded)
    file = root / "data/chunk-000/episode_000001.parquet"
    pq.write_table(change(pq.read_table(file)), file)
    with pytest.raises(RawFolderError) as error:
        read_lerobot(root, "avoiding")
    assert error.value.problems[0].startswith(f"{file}: {problem}"), error.value.problems


def test_faults_of_all_files_come_together(tmp_path, recorded):
    root = write_lerobot(tmp_path, recorded)
    files = sorted((root / "data").rglob("*.parquet"))
    files[0].write_bytes(b"PAR1 no more")
    pq.write_table(pq.read_table(files[2]).drop_columns(["action", "frame_index"]), files[2])
    with pytest.raises(RawFolderError) as error:
        read_lerobot(root, "avoiding")
    assert [str(problem).split(":")[0] for problem in error.value.problems] == [str(files[i]) for i in (0, 2, 2)]
    assert "cannot be read" in error.value.problems[0]


@pytest.mark.parametrize("version", VERSIONS)
def test_missing_episodes_are_told(tmp_path, recorded, version):
    root = write_lerobot(tmp_path, recorded, version)
    for file in (root / "data").rglob("*.parquet"):
        content = pq.read_table(file)
        content = content.filter(pa.compute.not_equal(content["episode_index"], 1))
        pq.write_table(content, file) if len(content) else file.unlink()
    with pytest.raises(RawFolderError, match="1 episodes are missing: 1"):
        read_lerobot(root, "avoiding")
    for file in [
        *root.rglob("episodes.jsonl"),
        *(root / "meta/episodes").rglob("*.parquet"),
        *root.rglob("*.safetensors"),
    ]:
        file.unlink()
    if version == "v1.6":  # nothing is left that tells how many there were
        assert torch.equal(read_lerobot(root, "avoiding")["action"], recorded["action"][recorded["episode"] != 1])
    else:
        with pytest.raises(RawFolderError, match="1 episodes are missing: 1"):
            read_lerobot(root, "avoiding")


def test_one_row_is_too_short(tmp_path, recorded):
    root = write_lerobot(tmp_path, recorded, "v1.6", change=lambda content: content.slice(0, 1))
    (root / "meta_data/episode_data_index.safetensors").unlink()
    with pytest.raises(RawFolderError, match="episode 0 is too short"):
        read_lerobot(root, "avoiding")


def test_folders_that_are_none(tmp_path, recorded):
    assert not is_lerobot(tmp_path)
    with pytest.raises(FileNotFoundError, match="no LeRobot data set in"):
        read_lerobot(tmp_path, "avoiding")
    with pytest.raises(FileNotFoundError, match="no demonstrations"):
        D3ILExperienceReplay("avoiding", tmp_path)
    with pytest.raises(ValueError, match="actions='absolute' is for LeRobot data sets"):
        D3ILExperienceReplay("avoiding", tmp_path, actions="absolute")
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text("{}")
    with pytest.raises(FileNotFoundError, match=r"no \*\.parquet below"):
        read_lerobot(tmp_path, "avoiding")
    root = write_lerobot(tmp_path / "set", recorded)
    for text, message in (("{", "info.json is no JSON"), ("[1]", "must hold a dictionary, got list")):
        (root / "meta/info.json").write_text(text)
        with pytest.raises(ValueError, match=message):
            read_lerobot(root, "avoiding")
    root = write_lerobot(tmp_path / "other", recorded)
    (root / "meta/episodes.jsonl").write_text('{"episode_index": 0}')
    with pytest.raises(ValueError, match="list of its episodes cannot be read"):
        read_lerobot(root, "avoiding")


def test_suspicious_data_are_told(tmp_path, warnings, recorded):
    read_lerobot(write_lerobot(tmp_path / "slow", recorded, fps=10), "avoiding")
    assert len(warnings) == 1 and "10 frames per second, task 'avoiding' has 28.57" in warnings[0]
    data = made_up("sorting")
    for frames in (data["observation"], data["next", "observation"]):
        frames[:, 6::3] *= 1e-4  # what quaternions read in the wrong order give for boxes that lie flat
    root = write_lerobot(tmp_path / "sorting", data)
    read_lerobot(root, "sorting")
    assert len(warnings) == 2 and "tan(yaw) is near zero everywhere" in warnings[1]
    read_lerobot(root, "po_sorting")
    assert len(warnings) == 2


def test_without_pyarrow_the_extra_is_named(tmp_path, recorded, monkeypatch):
    root = write_lerobot(tmp_path, recorded)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "pyarrow" else find_spec(name))
    with pytest.raises(RuntimeError, match=r"pip install 'torchrl_koap\[lerobot\]'"):
        read_lerobot(root, "avoiding")
