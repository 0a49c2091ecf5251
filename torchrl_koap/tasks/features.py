# This source code is licensed under the MIT license found in the LICENSE file.
"""Observation columns as numbers that a network can predict: angles without jumps and poles.

D3IL hands out ``tan(yaw)``, which grows without bound near +-90 deg, and whole quaternions, of which a box on a table
uses one angle. Both become a point on the unit circle. Nothing is lost that a task needs: ``tan(yaw)`` says no more
than the yaw up to half a turn.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor


def plain(columns: Tensor) -> Tensor:
    """The columns as they are."""
    return columns


def plane(position: Tensor) -> Tensor:
    """``x, y`` of a position ``[*B, 3]`` whose height is that of the surface it lies on."""
    return position[..., :2]


def double_yaw(tan_yaw: Tensor) -> Tensor:
    """``cos 2 yaw, sin 2 yaw`` from ``tan(yaw)`` ``[*B, 1]``: continuous where the tangent has its poles.

    Examples:
        >>> import math, torch
        >>> from torchrl_koap.tasks.features import double_yaw
        >>> double_yaw(torch.tensor([[1.0], [float("inf")]])).round(decimals=3).abs()
        tensor([[0., 1.],
                [1., 0.]])
    """
    double = 2 * tan_yaw.atan()
    return torch.cat([double.cos(), double.sin()], -1)


def yaw_of(quaternion: Tensor) -> Tensor:
    """``cos yaw, sin yaw`` from quaternions ``[*B, 4]`` (w, x, y, z); of both signs of a quaternion the same.

    Examples:
        >>> import torch
        >>> from torchrl_koap.tasks.features import yaw_of
        >>> yaw_of(torch.tensor([[0.0, 0.0, 0.0, -1.0]]))
        tensor([[-1.,  0.]])
    """
    w, x, y, z = quaternion.unbind(-1)
    direction = torch.stack([1 - 2 * (y * y + z * z), 2 * (w * z + x * y)], -1)
    return direction / direction.norm(dim=-1, keepdim=True).clamp_min(1e-6)


def tan_yaw(quaternion: np.ndarray) -> np.ndarray:
    """Tangent of the yaw as D3IL computes it: environments and readers of recordings must agree on it.

    The sign of ``x y`` is the original's, which matters for tilted boxes only.

    Args:
        quaternion (np.ndarray): ``[..., 4]`` (w, x, y, z).

    Returns:
        np.ndarray: ``[...]``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.tasks.features import tan_yaw
        >>> print(f"{tan_yaw(np.array([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])):.4f} = tan(0.5) = {np.tan(0.5):.4f}")
        0.5463 = tan(0.5) = 0.5463
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.tan(np.arctan2(2 * (w * z - x * y), 1 - 2 * (y**2 + z**2)))


# names that a feature gives to its columns; those of a plain part, and of a feature of one's own, are numbered
FEATURE_COLUMNS = {"plane": ("x", "y"), "tan_yaw": ("cos_2yaw", "sin_2yaw"), "quaternion": ("cos_yaw", "sin_yaw")}
# a feature of one's own is named by its import string
FEATURES = {"plain": plain, "plane": plane, "tan_yaw": double_yaw, "quaternion": yaw_of}
