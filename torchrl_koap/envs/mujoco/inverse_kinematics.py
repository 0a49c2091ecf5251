# This source code is licensed under the MIT license found in the LICENSE file.
"""Poses of the tool centre point (TCP) as joint commands.

D3IL's Stacking data were recorded so: a person commanded poses, policies learn the joint targets that followed.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from torchrl_koap.envs.mujoco.kinematics import forward_kinematics, inverse_kinematics


@njit(cache=True)
def _poses(joints, positions, quaternions):
    axes, origins = np.empty((8, 3, 3)), np.empty((8, 3))
    for row in range(len(joints)):
        forward_kinematics(joints[row], axes, origins, positions[row], quaternions[row])


@njit(cache=True)
def _follow(joints, poses, iterations):
    axes, origins = np.empty((8, 3, 3)), np.empty((8, 3))
    tcp, quat = np.empty(3), np.empty(4)
    jacobian, matrix, factor, vectors = np.empty((6, 7)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    task, null = np.empty(6), np.empty(7)
    for row in range(len(joints)):
        for _ in range(iterations):
            scratch = (axes, origins, tcp, quat, jacobian, matrix, task, null, factor, vectors)
            inverse_kinematics(poses[row], joints[row], *scratch)


def tcp_pose(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes positions [n, 3] (m) and quaternions [n, 4] (w, x, y, z) of the TCP for joint angles [n, 7] (rad)."""
    joints = _rows(joints, "joints")
    positions, quaternions = np.empty((len(joints), 3)), np.empty((len(joints), 4))
    _poses(joints, positions, quaternions)
    return positions, quaternions


def follow_pose(joints: np.ndarray, poses: np.ndarray, substeps: int = 30) -> np.ndarray:
    """Computes the joint targets [n, 7] that the controller reaches when it tracks poses for one control step.

    Args:
        joints (np.ndarray): present joint targets [n, 7] (rad).
        poses (np.ndarray): wanted TCP position (m) and unit quaternion [n, 7]. In 30 ms positions some centimetres
            away are reached, and turns for about three quarters.
        substeps (int): milliseconds of tracking.

    Raises:
        ValueError: if a shape is wrong.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.envs.mujoco.inverse_kinematics import follow_pose, tcp_pose
        >>> from torchrl_koap.envs import StackingEnv
        >>> joints = follow_pose([StackingEnv.START_JOINTS], [[0.53, 0.01, 0.29, 0, 1, 0, 0]])
        >>> tcp_pose(joints)[0].round(4).tolist()
        [[0.53, 0.01, 0.29]]
    """
    joints, poses = _rows(joints, "joints").copy(), _rows(poses, "poses")
    if len(joints) != len(poses):
        raise ValueError(f"as many poses as rows of joints are needed, got {len(poses)} and {len(joints)}")
    _follow(joints, poses, substeps)
    return joints


def _rows(array, name: str) -> np.ndarray:
    array = np.ascontiguousarray(array, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 7:
        raise ValueError(f"{name} must be [n, 7], got shape {list(array.shape)}")
    return array
