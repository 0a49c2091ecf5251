# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw episodes: what is written is read back; every fault is named; nothing is damaged by a failed save."""

from __future__ import annotations

import errno
import os
import pickle
import re
import stat

import numpy as np
import pytest
from shared_data import HUMAN

from torchrl_koap.data import RawEpisode, RawEpisodeError, read_raw_episode, write_raw_episode
from torchrl_koap.data.d3il import raw as raw_module
from torchrl_koap.data.d3il.raw import OBJECT_COLUMNS, ROBOT_COLUMNS
from torchrl_koap.files import replacing_folder


def episode(rows=6, seed=0, objects=()):
    rng = np.random.default_rng(seed)
    return RawEpisode(
        robot={key: rng.normal(size=(rows, *shape)) for key, shape in ROBOT_COLUMNS.items()},
        objects={name: {key: rng.normal(size=(rows, *s)) for key, s in OBJECT_COLUMNS.items()} for name in objects},
        context=[(0.1, np.zeros(2))] if objects else None,
    )


def problems(path, **kwargs):
    with pytest.raises(RawEpisodeError) as error:
        read_raw_episode(path, **kwargs)
    assert all(path.name in problem for problem in error.value.problems)
    return error.value.problems


@pytest.mark.parametrize("objects", [(), ("red-box", "target-box")])
def test_round_trip(tmp_path, objects):
    written = episode(objects=objects)
    write_raw_episode(tmp_path / "new" / "env_000_00.pkl", written)
    read = read_raw_episode(tmp_path / "new" / "env_000_00.pkl", robot=list(ROBOT_COLUMNS), objects=objects)
    assert len(read) == 6
    for key, value in written.robot.items():
        np.testing.assert_array_equal(read.robot[key], value)
    assert set(read.objects) == set(objects)
    for name in objects:
        np.testing.assert_array_equal(read.objects[name]["quat"], written.objects[name]["quat"])
    # other tools use the ordinary unpickler
    with open(tmp_path / "new" / "env_000_00.pkl", "rb") as file:
        plain = pickle.load(file)
    assert set(plain) == {"context", "robot", *objects}
    plain["robot"]["c_pos"][0] = 0.0  # writable there
    assert [entry.name for entry in (tmp_path / "new").iterdir()] == ["env_000_00.pkl"]


def test_written_files_can_be_read_by_others(tmp_path):
    write_raw_episode(tmp_path / "a.pkl", episode())
    (tmp_path / "plain").touch()
    assert stat.S_IMODE((tmp_path / "a.pkl").stat().st_mode) == stat.S_IMODE((tmp_path / "plain").stat().st_mode)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.pop("c_pos"), "missing key 'robot/c_pos'"),
        (lambda r: r.update(c_pos=r["c_pos"][:-1]), "unequal lengths: .*c_pos 5"),
        (
            lambda r: r["c_pos"].__setitem__((3, 1), np.nan),
            "'robot/c_pos' is NaN or infinite in 1 values, first in row 3",
        ),
        (lambda r: r["c_pos"].__setitem__((0, 0), -np.inf), "'robot/c_pos' is NaN or infinite"),
        (lambda r: r.update(c_pos=r["c_pos"][:, :2]), r"'robot/c_pos' must have shape \(T, 3\), got \(6, 2\)"),
        (lambda r: r.update(gripper_width=r["c_pos"]), r"must have shape \(T,\), got \(6, 3\)"),
        (lambda r: r.update(c_pos=r["c_pos"].tolist()), r"must be an array \(T, 3\), got list"),
        (lambda r: r.update(c_pos=np.full((6, 3), "x")), "real numbers"),
        (lambda r: r.update(c_pos=r["c_pos"] + 1j), "real numbers"),
    ],
)
def test_faults_are_named(tmp_path, change, message):
    content = {"context": None, "robot": dict(episode().robot)}
    change(content["robot"])
    path = tmp_path / "env_004_01.pkl"
    path.write_bytes(pickle.dumps(content))
    found = problems(path, robot=["c_pos", "des_c_pos"])
    assert len(found) == 1 and re.search(message, found[0]), found


def test_all_faults_at_once(tmp_path):
    content = {"robot": dict(episode().robot), "red-box": {"pos": np.zeros((6, 2))}}
    del content["robot"]["c_pos"]
    content["robot"]["j_pos"] = np.full((6, 7), np.nan)
    path = tmp_path / "env.pkl"
    path.write_bytes(pickle.dumps(content))
    found = problems(path, robot=["c_pos"], objects=["red-box", "blue-box"])
    assert len(found) == 5
    text = "\n".join(found)
    for part in ("'robot/c_pos'", "'robot/j_pos' is NaN", "'red-box/pos' must have", "'red-box/quat'", "'blue-box'"):
        assert part in text


@pytest.mark.parametrize("content", [[1, 2], {"robot": [1]}, {"observation": np.zeros(3)}, None])
def test_other_contents(tmp_path, content):
    path = tmp_path / "other.pkl"
    path.write_bytes(pickle.dumps(content))
    assert "missing key 'robot'" in problems(path)[0]


def test_too_short_empty_damaged_hostile_absent(tmp_path):
    write_raw_episode(tmp_path / "one.pkl", episode(rows=1))
    assert "too short: 1 rows, at least 2" in problems(tmp_path / "one.pkl")[0]
    (tmp_path / "empty.pkl").touch()
    assert "empty" in problems(tmp_path / "empty.pkl")[0]
    (tmp_path / "cut.pkl").write_bytes((tmp_path / "one.pkl").read_bytes()[:-20])
    assert "not a complete pickle" in problems(tmp_path / "cut.pkl")[0]
    (tmp_path / "hostile.pkl").write_bytes(pickle.dumps(os.system))
    assert "system" in problems(tmp_path / "hostile.pkl")[0]
    with pytest.raises(FileNotFoundError):
        read_raw_episode(tmp_path / "absent.pkl")


def test_broken_episodes_are_not_written(tmp_path):
    broken = episode()
    broken.robot["c_pos"][2] = np.nan
    with pytest.raises(RawEpisodeError, match="robot/c_pos"):
        write_raw_episode(tmp_path / "a.pkl", broken)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_leaves_the_earlier_file(tmp_path, monkeypatch):
    path = tmp_path / "a.pkl"
    write_raw_episode(path, episode(seed=1))
    before = path.read_bytes()

    def full(content, file, protocol):
        file.write(b"half of it")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(raw_module.pickle, "dump", full)
    with pytest.raises(OSError, match="No space left"):
        write_raw_episode(path, episode(seed=2))
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("moment", ["writing", "renaming"])
def test_a_failed_folder_leaves_the_earlier_one(tmp_path, monkeypatch, moment):
    with replacing_folder(tmp_path / "set") as aside:
        (aside / "part").write_text("old")
    real, calls = os.replace, []

    def fail_second(source, target):
        calls.append(source)
        if len(calls) == 3:  # new to its place (refused: it is full), old aside, new to its place
            raise OSError(errno.ENOSPC, "No space left on device")
        real(source, target)

    with pytest.raises(OSError, match="No space left"), replacing_folder(tmp_path / "set") as aside:
        (aside / "part").write_text("new")
        if moment == "writing":
            raise OSError(errno.ENOSPC, "No space left on device")
        monkeypatch.setattr(os, "replace", fail_second)
    assert (tmp_path / "set" / "part").read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]
    monkeypatch.undo()
    with replacing_folder(tmp_path / "set") as aside:
        (aside / "part").write_text("new")
    assert (tmp_path / "set" / "part").read_text() == "new"
    assert [entry.name for entry in tmp_path.iterdir()] == ["set"]


@pytest.mark.skipif(not HUMAN.is_dir(), reason=f"the human demonstrations are not at {HUMAN}")
def test_human_demonstrations_survive_a_round_trip(tmp_path):
    files = sorted(HUMAN.glob("env_*.pkl"))
    assert len(files) == 24
    for file in files[:3]:
        read = read_raw_episode(file, robot=list(ROBOT_COLUMNS))
        assert 65 <= len(read) <= 104 and not read.objects and read.context is None
        write_raw_episode(tmp_path / file.name, read)
        again = read_raw_episode(tmp_path / file.name)
        for key, value in read.robot.items():
            np.testing.assert_array_equal(again.robot[key], value)
            assert again.robot[key].dtype == value.dtype
