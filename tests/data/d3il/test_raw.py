# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw episodes: what is there is read; every fault is named."""

from __future__ import annotations

import pickle
import re

import numpy as np
import pytest
from raw_episodes import made_up, write_raw_episode

from torchrl_koap.data.d3il.raw import OBJECT_COLUMNS, ROBOT_COLUMNS, read_raw_episode
from torchrl_koap.files import DataError


def episode():
    return made_up("avoiding", rows=6).robot


def problems(path, **kwargs):
    with pytest.raises(DataError) as error:
        read_raw_episode(path, **kwargs)
    assert path.name in str(error.value)
    return error.value.problems


@pytest.mark.parametrize("names", [(), ("red-box", "target-box")])
def test_what_is_there_is_read(tmp_path, names):
    objects = {name: {key: np.ones((6, *shape)) for key, shape in OBJECT_COLUMNS.items()} for name in names}
    path = write_raw_episode(tmp_path / "env_000_00.pkl", episode(), objects, context=[(0.1, np.zeros(2))])
    read = read_raw_episode(path, robot=list(ROBOT_COLUMNS), objects=names)
    for key, value in episode().items():
        np.testing.assert_array_equal(read.robot[key], value)
    assert set(read.objects) == set(names)


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
    content = {"context": None, "robot": episode()}
    change(content["robot"])
    path = tmp_path / "env_004_01.pkl"
    path.write_bytes(pickle.dumps(content))
    found = problems(path, robot=["c_pos", "des_c_pos"])
    assert len(found) == 1 and re.search(message, found[0]), found


def test_all_faults_at_once(tmp_path):
    content = {"robot": episode(), "red-box": {"pos": np.zeros((6, 2))}}
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
