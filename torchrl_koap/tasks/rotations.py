# This source code is licensed under the MIT license found in the LICENSE file.
"""The yaw of a box as D3IL computes it: environments and readers of recordings must agree on it."""

from __future__ import annotations

import numpy as np


def tan_yaw(quaternion: np.ndarray) -> np.ndarray:
    """Tangent of the yaw; with the original's sign of ``x y``, which matters for tilted boxes only.

    Args:
        quaternion (np.ndarray): ``[..., 4]`` (w, x, y, z).

    Returns:
        np.ndarray: ``[...]``.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.tasks.rotations import tan_yaw
        >>> print(f"{tan_yaw(np.array([np.cos(0.25), 0.0, 0.0, np.sin(0.25)])):.4f} = tan(0.5) = {np.tan(0.5):.4f}")
        0.5463 = tan(0.5) = 0.5463
    """
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.tan(np.arctan2(2 * (w * z - x * y), 1 - 2 * (y**2 + z**2)))
