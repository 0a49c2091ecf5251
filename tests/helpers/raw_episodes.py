# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes demonstrations in the format of D3IL's recorder."""

import pickle
from pathlib import Path

import numpy as np

from torchrl_koap.data.d3il.conversion import CONVERTERS, ROBOT_COLUMNS
from torchrl_koap.tasks import get_task


def write_raw_episode(path, robot, objects=None, context=None):
    """Writes one pickle: arrays ``[T, ...]`` of the robot by name, and of every object."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"context": context, "robot": dict(robot), **(objects or {})}
    path.write_bytes(pickle.dumps(content, protocol=4))
    return path


def pose(positions, quat):
    return {"pos": np.array(positions, dtype=float), "quat": quat}


def made_up(task, rows=5, seed=0):
    rng = np.random.default_rng(seed)
    robot = {key: rng.normal(size=(rows, *shape)) for key, shape in ROBOT_COLUMNS.items()}
    objects = {}
    for name in CONVERTERS[get_task(task).source].objects:
        half = np.radians(rng.uniform(-80, 80, rows)) / 2  # turned about z
        quat = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)
        objects[name] = pose(rng.normal(size=(rows, 3)), quat)
    return robot, objects


def write_folder(folder, task, episodes=3):
    files = [Path(folder) / f"env_{index:03d}_00.pkl" for index in range(episodes)]
    for index, file in enumerate(files):
        write_raw_episode(file, *made_up(task, rows=4 + index, seed=index))
    return files
