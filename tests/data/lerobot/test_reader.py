# This source code is licensed under the MIT license found in the LICENSE file.
"""LeRobot folders of every format give the data they were made of."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lerobot_sets import VERSIONS, episodes_of, made_up, with_column, write_lerobot

from torchrl_koap.commands.doctor import Validate
from torchrl_koap.data import D3ILExperienceReplay, RawFolderError, read_about, read_lerobot
from torchrl_koap.data.d3il import replay as d3il_module
from torchrl_koap.data.lerobot.files import read_lerobot_folder
from torchrl_koap.data.lerobot.reader import column_names
from torchrl_koap.keys import validate
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.training.datasets import load_demonstrations

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra lerobot)")
import pyarrow as pa  # noqa: E402
import pyarrow.compute  # noqa: E402


def test_column_names_are_one_per_column_and_differ():
    for task in TASKS.values():
        assert len(set(column_names(task))) == task.observation_dim
    assert column_names(get_task("avoiding")) == ["desired_xy_0", "desired_xy_1", "measured_xy_0", "measured_xy_1"]


@pytest.mark.parametrize("version", VERSIONS)
def test_round_trip_of_recorded_demonstrations(tmp_path, recorded, version, warnings):
    root = write_lerobot(tmp_path / "set", recorded, version)
    data = validate(read_lerobot(root, "avoiding"))
    assert data.shape == recorded.shape and (data == recorded).all()
    dataset = D3ILExperienceReplay("avoiding", root, cache=tmp_path / "cache", batch_size=4)
    assert (dataset.data.exclude("state") == recorded).all()
    assert torch.equal(dataset.data["state"], recorded["observation"][:, 2:])
    assert (load_demonstrations(str(root), get_task("avoiding")).exclude("state") == recorded).all()
    assert Validate(dataset=str(root))()["trajectories"] == "3"
    assert not warnings


@pytest.mark.parametrize("task", TASKS)
def test_every_task(tmp_path, task):
    data = made_up(task)
    root = write_lerobot(tmp_path, data, "v3.0", fps=TASKS[task].control_hz)
    assert (read_lerobot(root, task) == data).all()
    state = load_demonstrations(str(root), get_task(task))["state"]
    torch.testing.assert_close(
        state, get_task(task).state_of(data["observation"]), rtol=0, atol=6 * get_task(task).noise
    )


def test_rows_may_lie_in_any_order(tmp_path, recorded):
    generator = np.random.default_rng(0)
    root = write_lerobot(
        tmp_path, recorded, "v3.0", change=lambda content: content.take(generator.permutation(len(content)))
    )
    assert (read_lerobot(root, "avoiding") == recorded).all()


@pytest.mark.parametrize("form", ["list", "nested", "motors", "numbers"])
def test_named_columns_may_come_in_any_order(tmp_path, recorded, form, warnings):
    order, extra = [3, 0, 4, 2, 1], "velocity"
    wanted = [*column_names(get_task("avoiding")), extra]
    names = [wanted[index] for index in order]

    def shuffled(rows):
        return [[[*row, 9.0][index] for index in order] for row in rows]

    given = {
        "list": names,
        "nested": [names],
        "motors": {"motors": names},
        "numbers": {name: index for index, name in reversed([*enumerate(names)])},
    }[form]
    change = with_column("observation.state", shuffled)
    root = write_lerobot(tmp_path, recorded, names=given, change=change)
    assert (read_lerobot(root, "avoiding") == recorded).all()
    assert not warnings


def test_the_environment_state_lies_behind_the_state(tmp_path):
    data = made_up("sorting_2")

    def apart(content):
        rows = content["observation.state"].to_pylist()
        content = with_column("observation.state", lambda rows: [row[:4] for row in rows])(content)
        return content.append_column("observation.environment_state", pa.array([row[4:] for row in rows]))

    root = write_lerobot(tmp_path, data, change=apart)
    assert read_lerobot_folder(root).widths == {"observation.state": 4, "observation.environment_state": 6}
    assert (read_lerobot(root, "sorting_2") == data).all()


def test_unknown_names_are_told(tmp_path, recorded, warnings):
    root = write_lerobot(tmp_path, recorded, names=["a", "b", "c", "d"])
    assert (read_lerobot(root, "avoiding") == recorded).all()
    assert len(warnings) == 1 and "names ['a', 'b', 'c', 'd'] are unknown" in warnings[0]
    (tmp_path / "generic").mkdir()
    read_lerobot(write_lerobot(tmp_path / "generic", recorded, names=["dim"]), "avoiding")
    assert len(warnings) == 1


@pytest.mark.parametrize("own_row", [False, True])
@pytest.mark.parametrize("task", ["avoiding", "stacking"])
def test_absolute_actions(tmp_path, task, own_row):
    data = made_up(task)
    command, size = get_task(task).observation[get_task(task).command], len(get_task(task).delta_actions)
    positions = torch.cat([frames[:, command] if own_row else frames[1:, command] for frames, _ in episodes_of(data)])
    rows = iter(positions.tolist())

    def absolute(actions):
        return [next(rows) for _ in actions] if own_row else [*(next(rows) for _ in actions[1:]), actions[-1]]

    root = write_lerobot(tmp_path, data, "v2.1", change=with_column("action", absolute))
    with pytest.raises(RawFolderError, match="does not hold changes of the desired position.*fit actions='absolute'"):
        read_lerobot(root, task)
    read = read_lerobot(root, task, actions="absolute")
    torch.testing.assert_close(read["action"], data["action"], rtol=0, atol=1e-6)
    assert torch.equal(read["observation"], data["observation"])
    assert torch.equal(read["action"][:, size:], data["action"][:, size:])
    dataset = D3ILExperienceReplay(task, root, actions="absolute", cache=tmp_path / "cache")
    assert torch.equal(dataset.data["action"], read["action"])
    with pytest.raises(RawFolderError):  # not taken from the cache of the other kind
        D3ILExperienceReplay(task, root, cache=tmp_path / "cache")


def test_actions_must_fit_the_desired_positions(tmp_path, recorded):
    root = write_lerobot(tmp_path / "late", recorded, change=with_column("action", lambda rows: [rows[0], *rows[:-1]]))
    with pytest.raises(RawFolderError) as error:
        read_lerobot(root, "avoiding")
    assert len(error.value.problems) == 3
    assert "episode_000001.parquet: episode 1: column 'action' does not hold changes" in error.value.problems[1]
    assert "they fit" not in error.value.problems[1]
    root = write_lerobot(tmp_path / "delta", recorded)
    with pytest.raises(RawFolderError, match="does not hold desired positions.*they fit actions='delta'"):
        read_lerobot(root, "avoiding", actions="absolute")
    with pytest.raises(ValueError, match="unknown kind of actions 'absolut'; did you mean 'absolute'"):
        read_lerobot(root, "avoiding", actions="absolut")
    swapped = with_column("observation.state", lambda rows: [row[2:] + row[:2] for row in rows])
    with pytest.raises(RawFolderError, match="does not hold changes"):  # measured first, without names
        read_lerobot(write_lerobot(tmp_path / "swapped", recorded, change=swapped), "avoiding")


def test_splits(tmp_path, recorded):
    root = write_lerobot(tmp_path / "set", recorded, splits={"train": "0:2", "val": "2:3", "odd": "half", "no": "7:9"})
    train = D3ILExperienceReplay("avoiding", root, split_file="train", cache=tmp_path / "cache")
    assert (train.data.exclude("state") == recorded[recorded["episode"] < 2]).all()
    val = D3ILExperienceReplay("avoiding", root, split_file="val", cache=tmp_path / "cache")
    assert val.data_path != train.data_path
    assert torch.equal(val.data["action"], recorded["action"][recorded["episode"] == 2])
    assert len(D3ILExperienceReplay("avoiding", root, cache=tmp_path / "cache")) == len(recorded)
    for split, message in (
        ("vall", "unknown split of this LeRobot data set 'vall'; did you mean 'val'"),
        ("odd", "must look like '0:50', got 'half'"),
        ("no", "split 'no' holds none of the episodes"),
    ):
        with pytest.raises(ValueError, match=message):
            read_lerobot(root, "avoiding", split=split)


def test_the_cache_is_used_and_follows_the_files(tmp_path, recorded, monkeypatch):
    root = write_lerobot(tmp_path / "set", recorded, "v3.0")
    first = D3ILExperienceReplay("avoiding", root, cache=tmp_path / "cache")
    files = ["file-000.parquet", "info.json", "file-000.parquet", "file-001.parquet"]
    assert read_about(first.data_path)["notes"]["files"] == files
    read = []
    monkeypatch.setattr(d3il_module, "read_lerobot", lambda *args, **kwargs: read.append(1) or recorded)
    assert D3ILExperienceReplay("avoiding", root, cache=tmp_path / "cache").data_path == first.data_path and not read
    (root / "meta/info.json").write_text((root / "meta/info.json").read_text() + " ")
    D3ILExperienceReplay("avoiding", root, cache=tmp_path / "cache")
    assert read
