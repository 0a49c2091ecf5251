# This source code is licensed under the MIT license found in the LICENSE file.
"""Raw episodes become the columns of docs/appendix/d3il.md; D3IL's folders and lists; files of another task."""

import dataclasses
import math
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from raw_episodes import made_up, pose, turned, write_folder, write_raw_episode

from torchrl_koap.data import open_dataset
from torchrl_koap.data.d3il.conversion import CONVERTERS, RawEpisode, find_raw_files, read_raw
from torchrl_koap.files import DataError
from torchrl_koap.keys import validate
from torchrl_koap.tasks import TASKS, get_task

ROOT3 = math.sqrt(3)


D3IL = [name for name, task in TASKS.items() if task.source in CONVERTERS]


def convert(task, episode):
    return CONVERTERS[task].convert(episode)


def same(array, wanted):
    assert array.dtype == np.float64 and array.shape == np.shape(wanted)
    np.testing.assert_allclose(array, wanted, rtol=1e-12, atol=1e-14)


def test_avoiding():
    robot = {
        "des_c_pos": np.array([[0.5, -0.28, 0.12], [0.508, -0.28, 0.13], [0.508, -0.272, 0.14]]),
        "c_pos": np.array([[0.51, -0.29, 0.2], [0.52, -0.3, 0.3], [0.53, -0.31, 0.4]]),
    }
    frames, actions = convert("avoiding", RawEpisode(robot=robot))
    same(frames, [[0.5, -0.28, 0.51, -0.29], [0.508, -0.28, 0.52, -0.3], [0.508, -0.272, 0.53, -0.31]])
    same(actions, [[0.008, 0.0], [0.0, 0.008]])


def test_aligning():
    robot = {
        "des_c_pos": np.array([[0.5, -0.35, 0.25], [0.508, -0.35, 0.25], [0.508, -0.342, 0.24]]),
        "c_pos": np.array([[0.51, -0.36, 0.26], [0.52, -0.37, 0.27], [0.53, -0.38, 0.28]]),
    }
    objects = {  # in another order than that of the columns
        "target-box": pose([[0.45, 0.25, 0.0]] * 3, turned(90, 90, 90)),
        "push-box": pose([[0.4, -0.2, 0.01], [0.41, -0.21, 0.02], [0.42, -0.22, 0.03]], turned(0, 60, 120)),
    }
    frames, actions = convert("aligning", RawEpisode(robot=robot, objects=objects))
    half = math.sqrt(0.5)
    target = [0.45, 0.25, 0.0, half, 0, 0, half]
    box = [[0.4, -0.2, 0.01, 1, 0, 0, 0], [0.41, -0.21, 0.02, ROOT3 / 2, 0, 0, 0.5]]
    box.append([0.42, -0.22, 0.03, 0.5, 0, 0, ROOT3 / 2])
    same(frames[0], [0.5, -0.35, 0.25, 0.51, -0.36, 0.26, *box[0], *target])
    same(frames[1], [0.508, -0.35, 0.25, 0.52, -0.37, 0.27, *box[1], *target])
    same(frames[2], [0.508, -0.342, 0.24, 0.53, -0.38, 0.28, *box[2], *target])
    same(actions, [[0.008, 0.0, 0.0], [0.0, 0.008, -0.01]])


def test_sorting():
    robot = {
        "des_c_pos": np.array([[0.5, -0.3, 0.25], [0.51, -0.31, 0.26]]),
        "c_pos": np.array([[0.52, -0.32, 0.27], [0.53, -0.33, 0.28]]),
    }
    objects = {
        "blue-box2": pose([[0.6, 0.05, 0.13], [0.61, 0.06, 0.13]], turned(30, -30)),
        "blue-box1": pose([[0.62, -0.02, 0.13], [0.63, -0.03, 0.13]], turned(-60, 120)),
        "red-box1": pose([[0.41, -0.12, 0.13], [0.42, -0.13, 0.13]], turned(45, 135, sign=-1)),
        "red-box2": pose([[0.43, 0.07, 0.13], [0.44, 0.08, 0.13]], turned(0, 180)),
    }
    frames, actions = convert("sorting", RawEpisode(robot=robot, objects=objects))
    wanted = [
        [0.5, -0.3, 0.52, -0.32, 0.41, -0.12, 1, 0.43, 0.07, 0, 0.62, -0.02, -ROOT3, 0.6, 0.05, 1 / ROOT3],
        [0.51, -0.31, 0.53, -0.33, 0.42, -0.13, -1, 0.44, 0.08, 0, 0.63, -0.03, -ROOT3, 0.61, 0.06, -1 / ROOT3],
    ]
    same(frames, wanted)
    same(actions, [[0.01, -0.01]])


@pytest.mark.parametrize("num_boxes", [2, 6])
def test_the_boxes_of_other_sortings_follow_by_colour(num_boxes):
    task, half = f"sorting_{num_boxes}", num_boxes // 2
    boxes = [*(f"red-box{index + 1}" for index in range(half)), *(f"blue-box{index + 1}" for index in range(half))]
    episode = made_up(task)
    assert set(episode.objects) == set(boxes)
    frames, actions = convert(task, episode)
    assert frames.shape == (5, 4 + 3 * num_boxes) and actions.shape == (4, 2)
    for index, box in enumerate(boxes):
        same(frames[:, 4 + 3 * index : 6 + 3 * index], episode.objects[box]["pos"][:, :2])
        yaw = 2 * np.arctan2(episode.objects[box]["quat"][:, 3], episode.objects[box]["quat"][:, 0])
        same(frames[:, 6 + 3 * index], np.tan(yaw))


def test_the_yaw_of_a_tilted_box_is_the_original_s():
    """About z by 50 deg after about its own x by 20 deg: not 50 deg again, because the original turns ``x y`` over."""
    z, x = np.radians([50, 20]) / 2
    quat = np.array([[np.cos(z) * np.cos(x), np.cos(z) * np.sin(x), np.sin(z) * np.sin(x), np.sin(z) * np.cos(x)]] * 2)
    episode = made_up("sorting", rows=2)
    frames, _ = convert(
        "sorting", dataclasses.replace(episode, objects=episode.objects | {"red-box1": pose(quat[:, :3], quat)})
    )
    w, x, y, z = quat[0]
    yaw = np.arctan2(2 * (w * z - x * y), 1 - 2 * (y * y + z * z))
    same(frames[:, 6], np.tan([yaw, yaw]))
    assert 1 < 50 - np.degrees(yaw) < 3


@pytest.mark.parametrize("target", [False, True])
def test_stacking(target):
    rows = np.arange(3.0)[:, None]
    robot = {
        "des_j_pos": rows * [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7] + [1, 2, 3, 4, 5, 6, 7],
        "j_pos": rows * 0.01 + [11, 12, 13, 14, 15, 16, 17],
        "gripper_width": np.array([0.06, 0.07, 0.079]),
        "c_pos": rows * 0.001 + [0.5, 0.0, 0.3],
    }
    objects = {
        "blue-box": pose([[0.57, -0.1, 0.011]] * 3, turned(-45, -45, -45)),
        "green-box": pose([[0.4, -0.05, 0.012]] * 3, turned(60, 60, 60)),
        "red-box": pose([[0.41, -0.2, 0.013], [0.42, -0.19, 0.02], [0.43, -0.18, 0.03]], turned(0, 45, 30)),
    }
    if target:
        objects["target-box"] = pose([[0.5, 0.2, 0.0]] * 3, turned(7, 7, 7))
    frames, actions = convert("stacking", RawEpisode(robot=robot, objects=objects))
    boxes = [0.4, -0.05, 0.012, ROOT3, 0.57, -0.1, 0.011, -1]
    assert frames.shape == (3, 31)
    wanted = [1, 2, 3, 4, 5, 6, 7, 0.06, 0.41, -0.2, 0.013, 0, *boxes, 11, 12, 13, 14, 15, 16, 17, 0.06, 0.5, 0, 0.3]
    same(frames[0], wanted)
    wanted = [1.1, 2.2, 3.3, 4.4, 5.5, 6.6, 7.7, 0.07, 0.42, -0.19, 0.02, 1, *boxes]
    wanted += [11.01, 12.01, 13.01, 14.01, 15.01, 16.01, 17.01, 0.07, 0.501, 0.001, 0.301]
    same(frames[1], wanted)
    # seven changes, and what tells the gripper to open: more than the width that it is about to have
    same(actions, [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.08], [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.08]])


@pytest.mark.parametrize("task", D3IL)
def test_every_task_gets_its_columns(tmp_path, task):
    facts = get_task(task)
    write_folder(tmp_path / "raw", task)
    data = validate(open_dataset(tmp_path / "raw", task=facts)[0])
    assert data["observation"].shape == (12, facts.observation_dim) and data["action"].shape == (12, facts.action_dim)
    assert torch.equal(data["state"], facts.state_of(data["observation"]))
    # the command and the action give the next command
    command, size = facts.observation[facts.command], len(facts.delta_actions)
    reached = data["observation"][:, command][:, :size] + data["action"][:, :size]
    torch.testing.assert_close(reached, data["next", "observation"][:, command][:, :size], rtol=0, atol=1e-6)


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
    for other in ("train_files.pkl", "4_boxes_eval_files.pkl", "test_contexts.pkl"):  # lists are no demonstrations
        (folder / other).write_bytes(pickle.dumps([files[0].name]))
    for root in {tmp_path, *folder.parents[: len(Path(FOLDERS[task]).parts)], folder}:
        assert find_raw_files(CONVERTERS[task], root) == files, root


def test_absent_folders(tmp_path):
    with pytest.raises(FileNotFoundError, match="no folder .*nowhere"):
        find_raw_files(CONVERTERS["avoiding"], tmp_path / "nowhere")
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
    (tmp_path / "env_007_00.pkl").write_bytes(pickle.dumps({"robot": {"c_pos": np.full((4, 3), np.nan)}}))
    calls = []
    with pytest.raises(DataError) as error:
        read_raw(CONVERTERS["avoiding"], tmp_path, progress=lambda *done: calls.append(done))
    text = str(error.value)
    for part in (
        "003_00.pkl: asks for",
        "004_00.pkl: the file is empty",
        "005_00.pkl: too short",
        "007_00.pkl: missing",
    ):
        assert part in text
    assert len(error.value.problems) == 5 and "env_000" not in text and calls[-1] == (4, 5)


def broken(**arrays):
    """A change of arrays of the robot."""
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
    episode = made_up("sorting")
    content = {"robot": dict(episode.robot), **{name: dict(entry) for name, entry in episode.objects.items()}}
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
