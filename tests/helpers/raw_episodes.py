# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations as D3IL's recorder writes them, for what reads them."""

from __future__ import annotations

import pickle
from pathlib import Path


def write_raw_episode(path, robot, objects=None, context=None):
    """One pickle: arrays ``[T, ...]`` of the robot by name, and of every object."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"context": context, "robot": dict(robot), **(objects or {})}
    path.write_bytes(pickle.dumps(content, protocol=4))
    return path
