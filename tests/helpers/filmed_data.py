# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings of a robot of one's own, whose cameras see a square where it is."""

from pathlib import Path

import numpy as np


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
