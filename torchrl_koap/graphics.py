# This source code is licensed under the MIT license found in the LICENSE file.
"""Imports MuJoCo such that an unusable ``MUJOCO_GL`` back end fails only when pictures are drawn."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def no_graphics() -> Iterator[None]:
    """Sets ``MUJOCO_GL=disable`` inside the block, so that imports load no graphics library."""
    chosen = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        yield
    finally:
        if chosen is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = chosen


def import_mujoco() -> None:
    """Imports MuJoCo, before TorchRL does, if ``MUJOCO_GL`` is set; without graphics if that fails."""
    if not os.environ.get("MUJOCO_GL"):
        return
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        import mujoco  # noqa: F401
    except ModuleNotFoundError:
        return
    except Exception:  # back ends pass on any exception of their libraries
        if platform is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)  # the failed back end set it
        with no_graphics():
            import mujoco  # noqa: F401
