# This source code is licensed under the MIT license found in the LICENSE file.
"""LeRobot folders of every format give the data they were made of; whatever does not fit is named."""

from __future__ import annotations

import importlib.util
import json

import numpy as np
import pytest
import torch

from torchrl_koap.commands.doctor import Validate
from torchrl_koap.data import D3ILExperienceReplay, RawFolderError, flatten_trajectories, read_about, read_lerobot
from torchrl_koap.data.d3il import replay as d3il_module
from torchrl_koap.data.lerobot import reader as lerobot_module
from torchrl_koap.data.lerobot.files import is_lerobot, read_lerobot_folder
from torchrl_koap.data.lerobot.reader import column_names
from torchrl_koap.envs.experts.demonstrations import record_demonstrations
from torchrl_koap.keys import validate
from torchrl_koap.tasks import TASKS, get_task
from torchrl_koap.training.datasets import load_demonstrations

pytest.importorskip("pyarrow", reason="pyarrow is not installed (extra lerobot)")
import pyarrow as pa  # noqa: E402
import pyarrow.compute  # noqa: E402
import pyarrow.parquet as pq  # noqa: E402
from safetensors.numpy import save_file  # noqa: E402

VERSIONS = ("v1.6", "v2.1", "v3.0")


@pytest.fixture(scope="module")
def recorded():
    return record_demonstrations("avoiding", episodes=3, seed=4, num_threads=1)[0]


@pytest.fixture
def warnings(monkeypatch):
    """What the reader logs as a warning."""
    seen = []
    monkeypatch.setattr(lerobot_module.torchrl_logger, "warning", lambda text, *values: seen.append(text % values))
    return seen


def episodes_of(data):
    """Frames ``[T, obs]`` and actions ``[T, act]`` of every episode; nothing was recorded after the last frame."""
    pairs = []
    for number in data["episode"].unique():
        part = data[data["episode"] == number]
        frames = torch.cat([part["observation"], part["next", "observation"][-1:]])
        pairs.append((frames, torch.cat([part["action"], torch.zeros_like(part["action"][:1])])))
    return pairs


def made_up(task, lengths=(5, 8), seed=0):
    """Random observations of a task whose command follows from the actions."""
    generator = torch.Generator().manual_seed(seed)
    facts = get_task(task)
    size, frames_of, steps_of = facts.num_delta_actions, [], []
    command = facts.observation[facts.command] if facts.command else slice(0, facts.action_dim)
    for length in lengths:
        frames = torch.randn(length, facts.observation_dim, generator=generator, dtype=torch.float64)
        changes = frames[:, command].diff(dim=0)
        changes[:, size:] = frames[1:, command][:, size:]
        frames_of.append(frames)
        steps_of.append(changes)
    return flatten_trajectories(frames_of, steps_of)


def table(numbers, pairs, features=None, fixed=False):
    kind = pa.list_(pa.float32(), pairs[0][1].shape[1]) if fixed else pa.list_(pa.float32())
    columns = {
        "observation.state": pa.array([row for frames, _ in pairs for row in frames.tolist()], pa.list_(pa.float32())),
        "action": pa.array([row for _, steps in pairs for row in steps.tolist()], kind),
        "episode_index": pa.array(np.repeat(numbers, [len(frames) for frames, _ in pairs])),
        "frame_index": pa.array(np.concatenate([np.arange(len(frames)) for frames, _ in pairs])),
        "timestamp": pa.array(np.concatenate([np.arange(len(frames)) / 28.57 for frames, _ in pairs])),
        "next.done": pa.array([False] * sum(len(frames) for frames, _ in pairs)),
    }
    return pa.table(columns | (features or {}))


def write(file, content):
    file.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(content, file)


def write_lerobot(root, data, version="v2.1", *, names=None, splits=None, fps=1 / 0.035, change=None):
    """Writes a LeRobot data set; ``change`` is called with each table before it is written."""
    pairs, change = episodes_of(data), change or (lambda content: content)
    lengths = [len(frames) for frames, _ in pairs]
    info = {"codebase_version": version, "fps": fps}
    if version == "v1.6":
        write(root / "data/train-00000-of-00001.parquet", change(table(range(len(pairs)), pairs)))
        (root / "meta_data").mkdir()
        (root / "meta_data/info.json").write_text(json.dumps(info))
        ends = np.cumsum(lengths)
        save_file({"from": ends - lengths, "to": ends}, root / "meta_data/episode_data_index.safetensors")
        return root
    info |= {
        "total_episodes": len(pairs),
        "total_frames": sum(lengths),
        "splits": splits or {"train": f"0:{len(pairs)}"},
        "features": {"observation.state": {"dtype": "float32", "names": names}, "action": {"dtype": "float32"}},
    }
    listed = [{"episode_index": number, "tasks": ["avoid"], "length": size} for number, size in enumerate(lengths)]
    if version == "v2.1":
        for number, pair in enumerate(pairs):
            write(root / f"data/chunk-000/episode_{number:06d}.parquet", change(table([number], [pair], fixed=True)))
        (root / "meta").mkdir()
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in listed))
    else:
        write(root / "data/chunk-000/file-000.parquet", change(table(range(len(pairs) - 1), pairs[:-1])))
        write(root / "data/chunk-000/file-001.parquet", change(table([len(pairs) - 1], pairs[-1:])))
        write(root / "meta/episodes/chunk-000/file-000.parquet", pa.Table.from_pylist(listed))
    (root / "meta/info.json").write_text(json.dumps(info))
    return root


def with_column(name, edit):
    """A change of one column, given as a list of its rows."""

    def change(content):
        rows = content[name].to_pylist()
        position = content.column_names.index(name)
        return content.set_column(position, name, pa.array(edit(rows)))

    return change


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
    command, size = get_task(task).observation[get_task(task).command], get_task(task).num_delta_actions
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
