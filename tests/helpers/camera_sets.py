# This source code is licensed under the MIT license found in the LICENSE file.
"""Writes small LeRobot data sets with one camera, and recordings whose cameras show a moving square."""

from pathlib import Path

import numpy as np

from torchrl_koap.data.formats.writers import LeRobotWriter
from torchrl_koap.tasks import get_task

CAMERA = "observation.images.third_person"


def read(recordings, camera, index=0):
    """Reads all frames ``[T, height, width, 3]`` that a camera saw in one recording."""
    return np.stack(list(recordings.cameras[camera][index].read()))


def episode(embodiment, length=6, seed=0):
    generator = np.random.default_rng(seed)
    frames = generator.integers(0, 256, (length + 1, 8, 8, 3), dtype=np.uint8)
    action = generator.normal(size=(length, 7)) if embodiment == "robot" else None
    return frames, generator.normal(size=(length + 1, 3)), action


def write_camera_set(folder, embodiment, count=2, first=0):
    actions = get_task("scooping").action_names if embodiment == "robot" else ()
    writer = LeRobotWriter(
        folder, fps=10, state_names="xyz", action_names=actions, camera=CAMERA, embodiment=embodiment, task="scoop"
    )
    for seed in range(first, first + count):
        frames, states, actions = episode(embodiment, 6 + seed, seed)
        writer.add(states, actions, frames=frames)
    return writer.close()


def write_filmed(folder: Path, cameras=("top", "wrist"), trajectories=12, size=(16, 24), length=20) -> Path:
    generator = np.random.default_rng(0)
    for number in range(trajectories):
        path = np.clip(generator.normal(size=(length, 2)).cumsum(0) / 4 + 6, 0, 11)
        (folder / f"{number:02d}").mkdir(parents=True)
        np.savez(folder / f"{number:02d}.npz", states=path, actions=np.diff(path, axis=0), control_hz=10.0)
        for camera in cameras:
            frames = np.zeros((len(path), *size, 3), np.uint8)
            for frame, (x, y) in zip(frames, path.astype(int), strict=True):
                frame[y : y + 4, x : x + 4, len(camera) % 3] = 255
            np.save(folder / f"{number:02d}" / f"{camera}.npy", frames)
    return folder
