# This source code is licensed under the MIT license found in the LICENSE file.
"""Unitree G1: recordings of a real humanoid without simulator; 26 joints of arms and hands, targets as actions.

100 episodes at 30 Hz in LeRobot's format 2.1 (YifanTian07/G1-policy-train, MIT licence).
"""

from __future__ import annotations

from pathlib import Path

from proving_grounds.ground import SHARED, Ground

from torchrl_koap.data import read_recordings, save_demonstrations

DATA = SHARED / "unitree_g1"


def write(folder: Path) -> None:
    """Writes the recordings as a data set."""
    save_demonstrations(folder, read_recordings(DATA), action_kind="absolute")


GROUNDS = {"unitree_g1": Ground(write, "errors", (5,), 100, data=DATA)}
