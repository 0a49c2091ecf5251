# This source code is licensed under the MIT license found in the LICENSE file.
"""``MUJOCO_GL`` and imports: a back end that cannot be used stops pictures, not what draws none."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator


@contextlib.contextmanager
def no_graphics() -> Iterator[None]:
    """Hides ``MUJOCO_GL`` inside the block: what is imported there touches no graphics library."""
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
    """Imports MuJoCo before TorchRL does where ``MUJOCO_GL`` is set, and without graphics where that fails."""
    if not os.environ.get("MUJOCO_GL"):
        return
    platform = os.environ.get("PYOPENGL_PLATFORM")
    try:
        import mujoco  # noqa: F401
    except ModuleNotFoundError:
        return
    except Exception:  # the back ends raise whatever their libraries raise
        if platform is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)  # set by the one that failed
        with no_graphics():
            import mujoco  # noqa: F401
