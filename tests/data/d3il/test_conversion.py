# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the conversion of raw episodes to the columns of docs/appendix/d3il.md, D3IL's folders, wrong files."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from raw_episodes import made_up, pose, write_folder, write_raw_episode

from torchrl_koap.data.d3il.conversion import CONVERTERS, find_raw_files, read_raw
from torchrl_koap.files import DataError
from torchrl_koap.tasks import get_task


def same(array, wanted):
    assert array.dtype == np.float64 and array.shape == np.shape(wanted)
    np.testing.assert_allclose(array, wanted, rtol=1e-12, atol=1e-14)


def placed(box, size=2):
    return box["pos"][:, :size], np.tan(2 * np.arctan2(box["quat"][:, 3], box["quat"][:, 0]))


# columns of an observation by docs/appendix/d3il.md, from the arrays of the robot and of the objects
REDS, BLUES = (tuple(f"{colour}-box{number}" for number in (1, 2, 3)) for colour in ("red", "blue"))
HAND = ("des_c_pos", "c_pos")
COLUMNS = {
    "avoiding": lambda robot, objects: [robot[name][:, :2] for name in HAND],
    "aligning": lambda robot, objects: [
        *(robot[name] for name in HAND),
        *(objects[name][part] for name in ("push-box", "target-box") for part in ("pos", "quat")),
    ],
    "stacking": lambda robot, objects: [
        *(robot[name] for name in ("des_j_pos", "gripper_width")),
        *(part for colour in ("red", "green", "blue") for part in placed(objects[f"{colour}-box"], 3)),
        *(robot[name] for name in ("j_pos", "gripper_width", "c_pos")),
    ],
}
for _name, _half in {"sorting_2": 1, "sorting": 2, "sorting_6": 3}.items():
    COLUMNS[_name] = lambda robot, objects, half=_half: [
        *(robot[name][:, :2] for name in HAND),
        *(part for name in (*REDS[:half], *BLUES[:half]) for part in placed(objects[name])),
    ]


@pytest.mark.parametrize("task", COLUMNS)
def test_columns_of_every_task(task):
    robot, objects = made_up(task)
    wanted = np.column_stack(COLUMNS[task](robot, objects))
    in_another_order = dict(reversed(objects.items()))
    frames, actions = CONVERTERS[task].convert(robot, in_another_order)
    same(frames, wanted)
    moved = len(get_task(task).delta_actions)
    same(actions[:, :moved], np.diff(wanted[:, :moved], axis=0))


def test_while_the_gripper_opens_its_action_means_open():
    robot, objects = made_up("stacking", rows=4)
    robot["gripper_width"][:] = [0.06, 0.07, 0.079, 0.07]
    same(CONVERTERS["stacking"].convert(robot, objects)[1][:, 7], [0.08, 0.08, 0.07])


def test_the_yaw_of_a_tilted_box_is_the_original_s():
    """About z by 50 deg after about its own x by 20 deg: not 50 deg again, because the original turns ``x y`` over."""
    z, x = np.radians([50, 20]) / 2
    quat = np.array([[np.cos(z) * np.cos(x), np.cos(z) * np.sin(x), np.sin(z) * np.sin(x), np.sin(z) * np.cos(x)]] * 2)
    robot, objects = made_up("sorting", rows=2)
    frames, _ = CONVERTERS["sorting"].convert(robot, objects | {"red-box1": pose(quat[:, :3], quat)})
    w, x, y, z = quat[0]
    yaw = np.arctan2(2 * (w * z - x * y), 1 - 2 * (y * y + z * z))
    same(frames[:, 6], np.tan([yaw, yaw]))
    assert 1 < 50 - np.degrees(yaw) < 3


def test_the_box_that_never_moves_is_not_read(tmp_path):
    robot, objects = made_up("stacking")
    still = {"target-box": pose(np.zeros((5, 3)), np.zeros((5, 4)))}
    write_raw_episode(tmp_path / "env_000_00.pkl", robot, objects | still)
    (frames,), _ = read_raw(CONVERTERS["stacking"], tmp_path)
    same(frames, CONVERTERS["stacking"].convert(robot, objects)[0])


FOLDERS = {  # where D3IL keeps the files
    "avoiding": "avoiding/data",
    "aligning": "aligning/all_data/state",
    "sorting": "sorting/4_boxes/state",
    "sorting_2": "sorting/2_boxes/state",
    "sorting_6": "sorting/6_boxes/state",
    "stacking": "stacking/all_data",
}


@pytest.mark.parametrize("task", FOLDERS)
def test_the_folders_of_d3il(tmp_path, task):
    folder = tmp_path / "environments/dataset/data" / FOLDERS[task]
    files = write_folder(folder, task)
    for other in (
        "train_files.pkl",
        "4_boxes_eval_files.pkl",
        "test_contexts.pkl",
        "._env_000_00.pkl",
    ):  # no demonstrations
        (folder / other).write_bytes(pickle.dumps([files[0].name]))
    for root in {tmp_path, *folder.parents[: len(Path(FOLDERS[task]).parts)], folder}:
        assert find_raw_files(CONVERTERS[task], root) == files, root


def test_absent_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match="no demonstrations .*avoiding/data"):
        find_raw_files(CONVERTERS["avoiding"], tmp_path)


def faults(task, folder):
    with pytest.raises(DataError) as error:
        read_raw(CONVERTERS[task], folder)
    return error.value.problems


def test_demonstrations_of_another_task_are_refused(tmp_path):
    (file,) = write_folder(tmp_path, "aligning", episodes=1)
    assert faults("avoiding", tmp_path) == [f"{file}: of another task: it logs push-box, target-box, wanted no objects"]
    assert faults("stacking", tmp_path) == [
        f"{file}: missing key '{colour}-box'" for colour in ("red", "green", "blue")
    ]


def test_faults_of_all_files_come_together(tmp_path):
    rng = np.random.default_rng(0)
    for number, rows in ((0, 5), (5, 1)):
        robot = {name: rng.normal(size=(rows, 3)) for name in ("des_c_pos", "c_pos")}
        write_raw_episode(tmp_path / f"env_{number:03d}_00.pkl", robot)
    (tmp_path / "env_003_00.pkl").write_bytes(pickle.dumps(os.system))
    (tmp_path / "env_004_00.pkl").touch()
    (tmp_path / "env_006_00.pkl").mkdir()
    (tmp_path / "env_007_00.pkl").write_bytes(pickle.dumps({"robot": {"c_pos": np.full((4, 3), np.nan)}}))
    calls = []
    with pytest.raises(DataError) as error:
        read_raw(CONVERTERS["avoiding"], tmp_path, progress=lambda *done: calls.append(done))
    text = str(error.value)
    for part in (
        "003_00.pkl: asks for",
        "004_00.pkl: not a complete pickle",
        "005_00.pkl: too short",
        "006_00.pkl: cannot be read",
        "007_00.pkl: missing",
    ):
        assert part in text
    assert len(error.value.problems) == 6 and "env_000" not in text and calls[-1] == (5, 6)


def broken(**arrays):
    return lambda content: content["robot"].update({name: make(content["robot"]) for name, make in arrays.items()})


def with_nan(robot):
    return np.where(np.arange(15).reshape(5, 3) == 10, np.nan, robot["c_pos"])


@pytest.mark.parametrize(
    ("change", "problems"),
    [
        (lambda c: c.pop("red-box2"), ["missing key 'red-box2'"]),
        (lambda c: c.update({"red-box2": 3}), ["'red-box2' is no dictionary of arrays"]),
        (lambda c: c["blue-box1"].pop("quat"), ["missing key 'blue-box1/quat'"]),
        (broken(c_pos=with_nan), ["'robot/c_pos' is NaN or infinite in 1 values, first in row 3"]),
        (broken(c_pos=lambda r: r["c_pos"] / 0), ["'robot/c_pos' is NaN or infinite"]),
        (lambda c: c["red-box1"].update(quat=np.zeros((5, 3))), ["'red-box1/quat' must have shape (T, 4), got (5, 3)"]),
        (lambda c: c["red-box1"].update(quat=np.zeros((5, 4))), ["'red-box1/quat' has norm 0 in row 0, wanted 1"]),
        (
            lambda c: c["red-box1"]["quat"].__imul__([[1.005]] * 3 + [[1.02]] * 2),
            ["'red-box1/quat' has norm 1.02 in row 3"],
        ),
        (broken(gripper_width=lambda r: r["c_pos"]), ["'robot/gripper_width' must have shape (T,), got (5, 3)"]),
        (broken(c_pos=lambda r: r["c_pos"].tolist()), ["'robot/c_pos' must be an array (T, 3), got list"]),
        (broken(c_pos=lambda r: r["c_pos"].astype("U8")), ["'robot/c_pos' must hold real numbers, got dtype <U8"]),
        (broken(c_pos=lambda r: r["c_pos"] + 1j), ["'robot/c_pos' must hold real numbers, got dtype complex128"]),
        (lambda c: c["red-box1"].update(pos=np.zeros((4, 3))), ["unequal lengths: blue-box1/pos 5"]),
        (
            lambda c: (broken(j_pos=lambda r: r["j_pos"] * np.nan)(c), c["red-box1"].pop("quat"), c.pop("blue-box1")),
            ["'robot/j_pos' is NaN or infinite in 35 values", "missing key 'red-box1/quat'", "missing key 'blue-box1'"],
        ),
    ],
)
def test_what_is_missing_or_broken_is_named(tmp_path, change, problems):
    robot, objects = made_up("sorting")
    content = {"robot": robot, **objects}
    with np.errstate(divide="ignore"):
        change(content)
    file = tmp_path / "env_007_01.pkl"
    file.write_bytes(pickle.dumps(content))
    found = faults("sorting", tmp_path)
    assert len(found) == len(problems)
    for problem in problems:
        assert any(line.startswith(f"{file}: {problem}") for line in found), found


@pytest.mark.parametrize("content", [[1, 2], {"robot": [1]}, {"observation": np.zeros(3)}, None])
def test_other_contents(tmp_path, content):
    (tmp_path / "other.pkl").write_bytes(pickle.dumps(content))
    assert "missing key 'robot'" in faults("avoiding", tmp_path)[0]
