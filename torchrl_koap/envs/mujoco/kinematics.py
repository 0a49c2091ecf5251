# This source code is licensed under the MIT license found in the LICENSE file.
"""Compiled kinematics of the Panda arm: the pose of its tool centre point (TCP), and damped steps towards a pose.

Plain float64 arithmetic in a fixed order (docs/appendix/d3il.md, Controller); LAPACK's order depends on the machine.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from torchrl_koap.tasks.panda_kinematics import FLANGE_TO_TOOL, JOINT_HIGH, JOINT_LOW, LINKS

TIMESTEP = 0.001
# Joint 3's upper bound is 2.0 in the original although the joint reaches 2.8973.
Q_MIN, Q_MAX = np.array(JOINT_LOW), np.array([*JOINT_HIGH[:2], 2.0, *JOINT_HIGH[3:]])
Q_REST = np.array([0.0, 0.174, 0.0, -0.872, 0.0, 1.222, 0.785])

IK_ITERATIONS = 3
_OFFSETS, _TURNS = np.array([offset for offset, _ in LINKS]), np.array([turn for _, turn in LINKS])
_COS45 = 0.5**0.5
EIGENVALUE_MIN, EIGENVALUE_MAX = 0.01, 100.0


@njit(cache=True)
def forward_kinematics(q, axes, origins, tcp, quat):
    """Computes the frames of the arm's joints ``q`` [7] (rad) and the pose of the TCP, in the frame of its base.

    Writes the axes x, y, z of the joints' frames into rows 1-7 of ``axes`` [8, 3, 3] (row 0 ends as the hand's),
    their ``origins`` [8, 3] (m), the TCP's position ``tcp`` [3] (m) and its quaternion ``quat`` [4] (w, x, y, z).
    """
    axes[0], origins[0] = np.eye(3), 0.0
    for index in range(1, 8):
        along_x, along_y, along_z = _OFFSETS[index - 1]
        turn, c, s = _TURNS[index - 1], np.cos(q[index - 1]), np.sin(q[index - 1])
        for k in range(3):
            x, y, z = axes[index - 1, 0, k], axes[index - 1, 1, k], axes[index - 1, 2, k]
            origins[index, k] = origins[index - 1, k] + x * along_x + y * along_y + z * along_z
            if turn:  # a quarter about x
                y, z = turn * z, -turn * y
            axes[index, 0, k], axes[index, 1, k], axes[index, 2, k] = c * x + s * y, c * y - s * x, z
    for k in range(3):
        tcp[k] = origins[7, k] + FLANGE_TO_TOOL * axes[7, 2, k]
        # the hand is turned by exactly -45 deg about z
        axes[0, 0, k] = _COS45 * (axes[7, 0, k] - axes[7, 1, k])
        axes[0, 1, k] = _COS45 * (axes[7, 0, k] + axes[7, 1, k])
        axes[0, 2, k] = axes[7, 2, k]
    _quaternion(axes[0], quat)


@njit(cache=True)
def _quaternion(axes, quat):
    """Writes the quaternion (w, x, y, z) of the rotation whose columns are the rows of ``axes``."""
    xx, yy, zz = axes[0, 0], axes[1, 1], axes[2, 2]
    xy, yx, xz, zx, yz, zy = axes[1, 0], axes[0, 1], axes[2, 0], axes[0, 2], axes[2, 1], axes[1, 2]
    if xx + yy + zz > 0.0:
        s = 2.0 * np.sqrt(1.0 + xx + yy + zz)
        quat[0], quat[1], quat[2], quat[3] = 0.25 * s, (zy - yz) / s, (xz - zx) / s, (yx - xy) / s
    elif xx >= yy and xx >= zz:
        s = 2.0 * np.sqrt(1.0 + xx - yy - zz)
        quat[0], quat[1], quat[2], quat[3] = (zy - yz) / s, 0.25 * s, (xy + yx) / s, (xz + zx) / s
    elif yy >= zz:
        s = 2.0 * np.sqrt(1.0 + yy - xx - zz)
        quat[0], quat[1], quat[2], quat[3] = (xz - zx) / s, (xy + yx) / s, 0.25 * s, (yz + zy) / s
    else:
        s = 2.0 * np.sqrt(1.0 + zz - xx - yy)
        quat[0], quat[1], quat[2], quat[3] = (yx - xy) / s, (xz + zx) / s, (yz + zy) / s, 0.25 * s


@njit(cache=True)
def clip(value, low, high):
    """Returns the value, limited to ``low`` and ``high``."""
    return min(max(value, low), high)


@njit(cache=True)
def _cholesky(matrix, shift, factor):
    """Writes the lower Cholesky factor of ``matrix - shift * I``; returns False if it is not positive definite."""
    for i in range(6):
        for j in range(i + 1):
            total = matrix[i, j] - (shift if i == j else 0.0)
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = np.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    return True


@njit(cache=True)
def _diagonalise(matrix, vectors):
    """Cyclic Jacobi rotations: ``matrix`` becomes diagonal, the columns of ``vectors`` are the eigenvectors."""
    vectors[:] = np.eye(6)
    for _ in range(30):
        off, diagonal = 0.0, 0.0
        for i in range(6):
            diagonal += matrix[i, i] ** 2
            for j in range(i):
                off += matrix[i, j] ** 2
        if off <= 1e-32 * diagonal:
            break
        for p in range(5):
            for r in range(p + 1, 6):
                if matrix[p, r] == 0.0:
                    continue
                theta = (matrix[r, r] - matrix[p, p]) / (2.0 * matrix[p, r])
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                if theta < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                a, b = matrix[:, p].copy(), matrix[:, r].copy()
                matrix[:, p], matrix[:, r] = c * a - s * b, s * a + c * b
                a, b = matrix[p].copy(), matrix[r].copy()
                matrix[p], matrix[r] = c * a - s * b, s * a + c * b
                a, b = vectors[:, p].copy(), vectors[:, r].copy()
                vectors[:, p], vectors[:, r] = c * a - s * b, s * a + c * b


@njit(cache=True)
def solve_clipped(matrix, rhs):
    """Solves ``A x = b`` [6] for symmetric ``A`` [6, 6], its eigenvalues clipped to [0.01, 100]; overwrites both.

    Clipping is rarely active. Two cheap tests say so: ``A - 0.01 I`` has a Cholesky factor, and the trace is below 100.
    """
    factor = np.empty((6, 6))
    if np.trace(matrix) <= EIGENVALUE_MAX and _cholesky(matrix, EIGENVALUE_MIN, factor):
        _cholesky(matrix, 0.0, factor)
        for i in range(6):
            for k in range(i):
                rhs[i] -= factor[i, k] * rhs[k]
            rhs[i] /= factor[i, i]
        for i in range(5, -1, -1):
            for k in range(i + 1, 6):
                rhs[i] -= factor[k, i] * rhs[k]
            rhs[i] /= factor[i, i]
        return rhs
    vectors, solution = np.empty((6, 6)), np.zeros(6)
    _diagonalise(matrix, vectors)
    for j in range(6):
        total = 0.0
        for i in range(6):
            total += vectors[i, j] * rhs[i]
        factor[0, j] = total / clip(matrix[j, j], EIGENVALUE_MIN, EIGENVALUE_MAX)
    for i in range(6):
        for j in range(6):
            solution[i] += vectors[i, j] * factor[0, j]
    return solution


@njit(cache=True)
def inverse_kinematics(target, q):
    """Moves joint angles ``q`` [7] (rad) in place, by three damped steps, towards a TCP pose [7] (m, quaternion)."""
    axes, origins, tcp, quat = np.empty((8, 3, 3)), np.empty((8, 3)), np.empty(3), np.empty(4)
    jacobian, matrix, task, null = np.empty((6, 7)), np.empty((6, 6)), np.empty(6), np.empty(7)
    for _ in range(IK_ITERATIONS):
        forward_kinematics(q, axes, origins, tcp, quat)
        near = 0.0
        for k in range(4):
            near += quat[k] * target[3 + k]
        sign = -1.0 if near < 0.0 else 1.0
        tw, tx, ty, tz = sign * target[3], sign * target[4], sign * target[5], sign * target[6]
        w, x, y, z = quat[0], quat[1], quat[2], quat[3]
        for k in range(3):
            task[k] = (800.0 if k == 2 else 200.0) * clip(target[k] - tcp[k], -0.01, 0.01)
        task[3] = 30.0 * clip(w * tx - tw * x + (y * tz - z * ty), -0.1, 0.1)
        task[4] = 30.0 * clip(w * ty - tw * y + (z * tx - x * tz), -0.1, 0.1)
        task[5] = 30.0 * clip(w * tz - tw * z + (x * ty - y * tx), -0.1, 0.1)

        for j in range(7):
            zx, zy, zz = axes[j + 1, 2, 0], axes[j + 1, 2, 1], axes[j + 1, 2, 2]
            rx, ry, rz = tcp[0] - origins[j + 1, 0], tcp[1] - origins[j + 1, 1], tcp[2] - origins[j + 1, 2]
            jacobian[0, j], jacobian[1, j], jacobian[2, j] = zy * rz - zz * ry, zz * rx - zx * rz, zx * ry - zy * rx
            jacobian[3, j], jacobian[4, j], jacobian[5, j] = zx, zy, zz
            null[j] = 40.0 * clip(Q_REST[j] - q[j], -0.2, 0.2)
        for i in range(6):
            for k in range(7):
                task[i] -= jacobian[i, k] * null[k]
            for j in range(i + 1):
                total = 0.0
                for k in range(7):
                    total += jacobian[i, k] * jacobian[j, k]
                matrix[i, j] = matrix[j, i] = total
            matrix[i, i] += 1e-12
        task = solve_clipped(matrix, task)

        square = 0.0
        for j in range(7):
            for i in range(6):
                null[j] += jacobian[i, j] * task[i]
            square += null[j] * null[j]
        scale = 3.0 / np.sqrt(square) if square > 9.0 else 1.0
        for j in range(7):
            q[j] = clip(q[j] + TIMESTEP * scale * null[j], Q_MIN[j], Q_MAX[j])


def tcp_pose(joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Computes positions [n, 3] (m) and quaternions [n, 4] (w, x, y, z) of the TCP for joint angles [n, 7] (rad)."""
    joints = np.ascontiguousarray(joints, dtype=np.float64)
    positions, quaternions = np.empty((len(joints), 3)), np.empty((len(joints), 4))
    axes, origins = np.empty((8, 3, 3)), np.empty((8, 3))
    for row in zip(joints, positions, quaternions, strict=True):
        forward_kinematics(row[0], axes, origins, *row[1:])
    return positions, quaternions


def follow_pose(joints: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Computes the joint targets [n, 7] that the controller reaches when it tracks poses for one control step.

    D3IL's Stacking data hold these: a person commanded poses, and policies learn the resulting joint targets.
    ``joints`` are the present targets [n, 7] (rad), ``poses`` TCP positions (m) and unit quaternions [n, 7]. Positions
    some centimetres away are reached, and turns for about three quarters.
    """
    joints, poses = np.array(joints, dtype=np.float64), np.ascontiguousarray(poses, dtype=np.float64)
    for row, pose in zip(joints, poses, strict=True):
        for _ in range(30):  # ms of a control step of Stacking
            inverse_kinematics(pose, row)
    return joints
