# This source code is licensed under the MIT license found in the LICENSE file.
"""`dm_control.mjcf`, imported without touching a graphics library.

Importing ``dm_control`` opens whatever OpenGL back end it finds (and fails if ``MUJOCO_GL`` names one that is not
installed), although building a scene needs none. Pictures are drawn by ``mujoco.Renderer``, which is not affected. A
program that also wants dm_control's own renderer imports ``dm_control`` before this package.
"""

from __future__ import annotations

import os
import sys
import warnings

__all__ = ["mjcf"]

if "dm_control._render" in sys.modules:
    from dm_control import mjcf
else:
    import mujoco  # noqa: F401  it reads MUJOCO_GL for itself, so before the variable is hidden

    _chosen = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from dm_control import mjcf
    finally:
        if _chosen is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = _chosen
