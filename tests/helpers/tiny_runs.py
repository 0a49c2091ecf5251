# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations and options with which `koap train` takes a second."""

import csv
from pathlib import Path

import numpy as np
from raw_episodes import write_raw_episode

from torchrl_koap.commands.cli import main

TINY = (
    *("--steps", "20", "--planner.batch-size", "8", "--threads", "1"),
    *("--planner.network", "unet", "--planner.width", "8", "--labels", "2", "--controller.steps", "20"),
)
START = np.array([0.525, -0.28])


def koap(*arguments) -> int:
    """Runs a command in this process; returns its exit status."""
    return main([str(argument) for argument in arguments])


def grid(values: np.ndarray) -> np.ndarray:
    return np.round(values * 2**20) / 2**20


def demonstration(index: int, rows: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns commanded and measured path (rows, 2): an upward arc per index, followed with a lag."""
    time = np.linspace(0, 1, rows)
    bend = np.sin(np.pi * time) * (index - 3.5) / 40 + 0.004 * np.sin(9 * time + index)
    commanded = grid(START + np.stack([bend, 0.6 * time**1.5], 1))
    measured = commanded.copy()
    for row in range(1, rows):
        measured[row] = 0.6 * measured[row - 1] + 0.4 * commanded[row - 1]
    return commanded, measured


def write_demonstrations(folder: Path, *, episodes: int = 8, rows: int = 30, change=None) -> Path:
    """Writes raw pickles; ``change(index, commanded, measured)`` may alter both paths."""
    for index in range(episodes):
        commanded, measured = demonstration(index, rows + index)
        if change is not None:
            commanded, measured = change(index, commanded, measured)
        height = np.full((len(commanded), 1), 0.12)
        paths = {"des_c_pos": np.hstack([commanded, height]), "c_pos": np.hstack([measured, height])}
        write_raw_episode(Path(folder) / f"env_{index:03d}_00.pkl", paths)
    return Path(folder)


def read_csv(file: Path) -> list[dict[str, str]]:
    with Path(file).open(newline="", encoding="utf-8") as lines:
        return list(csv.DictReader(lines))
