# This source code is licensed under the MIT license found in the LICENSE file.
"""Forward kinematics of the Panda in torch (docs/appendix/d3il.md, Robot): joints to the position of the tool."""

from __future__ import annotations

import torch
from torch import Tensor

# for joints 1 to 7: offset along the parent's axes (m), then fixed quarter turns about x
# Numba's cache of compiled callers in other files ignores changes of this file: clear __pycache__ after a change
LINKS = (
    ((0.0, 0.0, 0.333), 0),
    ((0.0, 0.0, 0.0), -1),
    ((0.0, -0.316, 0.0), 1),
    ((0.0825, 0.0, 0.0), 1),
    ((-0.0825, 0.384, 0.0), -1),
    ((0.0, 0.0, 0.0), 1),
    ((0.088, 0.0, 0.0), 1),
)
JOINT_LOW = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)  # rad
JOINT_HIGH = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
FLANGE = 0.107  # m along the last joint's axis
FLANGE_TO_TOOL = 0.212  # m along the last joint's axis


def tool_position(joints: Tensor) -> Tensor:
    """Computes the position of the tool ``[*B, 3]`` (m, robot base at the origin) from arm joints ``[*B, 7]`` (rad)."""
    if joints.shape[-1] != 7:
        raise ValueError(f"seven joints are needed on the last axis, got shape {list(joints.shape)}")
    x, y, z = torch.eye(3, dtype=joints.dtype, device=joints.device).expand(*joints.shape[:-1], 3, 3).unbind(-1)
    position = torch.zeros_like(x)
    for index, ((along_x, along_y, along_z), turn) in enumerate(LINKS):
        position = position + along_x * x + along_y * y + along_z * z
        if turn:
            y, z = turn * z, -turn * y
        cosine, sine = joints[..., index : index + 1].cos(), joints[..., index : index + 1].sin()
        x, y = cosine * x + sine * y, cosine * y - sine * x
    return position + FLANGE_TO_TOOL * z
