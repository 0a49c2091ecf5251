# This source code is licensed under the MIT license found in the LICENSE file.
"""Observation columns as numbers that a network can predict: angles without jumps and poles.

D3IL hands out ``tan(yaw)``, which has poles, and whole quaternions, of which a box on a table uses one angle. Both
become a point on the unit circle; ``tan(yaw)`` tells the yaw up to half a turn only.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def plain(columns: Tensor) -> Tensor:
    """Returns the columns as they are."""
    return columns


def plane(position: Tensor) -> Tensor:
    """Returns ``x, y`` of a position ``[*B, 3]`` whose height is that of the surface it lies on."""
    return position[..., :2]


def double_yaw(tan_yaw: Tensor) -> Tensor:
    """Computes ``cos 2 yaw, sin 2 yaw`` from ``tan(yaw)`` ``[*B, 1]``: continuous where the tangent has its poles."""
    double = 2 * tan_yaw.atan()
    return torch.cat([double.cos(), double.sin()], -1)


def yaw_of(quaternion: Tensor) -> Tensor:
    """Computes ``cos yaw, sin yaw`` from quaternions ``[*B, 4]`` (w, x, y, z), whose sign does not matter."""
    w, x, y, z = quaternion.unbind(-1)
    direction = torch.stack([1 - 2 * (y * y + z * z), 2 * (w * z + x * y)], -1)
    return direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def tan_yaw(quaternion: np.ndarray) -> np.ndarray:
    """Computes the tangent of the yaw ``[...]`` of quaternions ``[..., 4]`` (w, x, y, z) as D3IL does.

    The sign of ``x y`` is the original's, which matters for tilted boxes only.
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.tan(np.arctan2(2 * (w * z - x * y), 1 - 2 * (y**2 + z**2)))


# names that a feature gives to its columns; those of a plain part, and of a feature of one's own, are numbered
FEATURE_COLUMNS = {"plane": ("x", "y"), "tan_yaw": ("cos_2yaw", "sin_2yaw"), "quaternion": ("cos_yaw", "sin_yaw")}
# a feature of one's own is named by its import string
FEATURES = {"plain": plain, "plane": plane, "tan_yaw": double_yaw, "quaternion": yaw_of}
