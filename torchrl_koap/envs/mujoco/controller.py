# This source code is licensed under the MIT license found in the LICENSE file.
"""The compiled controller: inverse kinematics, joint PD and finger force every millisecond (docs/d3il.md, Controller).

One call advances one simulation by all substeps of a control step without coming back to Python: the compiled loop
computes the motor commands and calls ``mj_step`` of the MuJoCo library through its address. It holds no interpreter
lock, so calls for different simulations run in parallel threads. Compiled code is cached on disk by numba.

Everything here works on one simulation at a time, with plain float64 arithmetic in a fixed order; results therefore do
not depend on how many simulations or threads there are.
"""

from __future__ import annotations

import ctypes
import functools
from pathlib import Path

import mujoco
import numpy as np
from llvmlite import ir
from numba import carray, njit, types
from numba.extending import intrinsic

from torchrl_koap.envs.mujoco.linear_algebra import clip, solve_clipped

TIMESTEP = 0.001
KP = np.array([120.0, 120.0, 120.0, 120.0, 50.0, 30.0, 10.0])
KD = np.array([10.0, 10.0, 10.0, 10.0, 6.0, 5.0, 3.0])
# Joint 3's upper bound is 2.0 in the original although the joint reaches 2.8973.
Q_MIN = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
Q_MAX = np.array([2.8973, 1.7628, 2.0, -0.0698, 2.8973, 3.7525, 2.8973])
Q_REST = np.array([0.0, 0.174, 0.0, -0.872, 0.0, 1.222, 0.785])

IK_ITERATIONS = 3
FINGER_OPEN = 0.04
FINGER_RESET = 0.001

# Columns of the pointer table: addresses of one simulation's arrays inside its mjData.
QPOS, QVEL, CTRL, BIAS, TCP_POS, TCP_QUAT, ANCHORS, JOINT_AXES, OBJECTS = range(9)
NUM_POINTERS = 9
# Columns of the log row written after the first substep of a control step; the free bodies' poses follow them.
LOG_COLUMNS = {
    "j_pos": slice(0, 7),
    "j_vel": slice(7, 14),
    "des_j_pos": slice(14, 21),
    "des_j_vel": slice(21, 28),
    "des_j_acc": slice(28, 35),
    "c_pos": slice(35, 38),
    "c_quat": slice(38, 42),
    "c_vel": slice(42, 45),
    "gripper_width": slice(45, 46),
}
LOG_WIDTH = 46

_COS45 = 0.5**0.5


@functools.cache
def step_address() -> int:
    """Address of ``mj_step`` in the MuJoCo library that the Python package has loaded.

    Raises:
        OSError: if the library is not found beside the ``mujoco`` package.
    """
    folder = Path(mujoco.__file__).parent
    found = [path for pattern in ("libmujoco.so*", "libmujoco*.dylib", "mujoco.dll") for path in folder.glob(pattern)]
    if not found:
        raise OSError(f"no MuJoCo library (libmujoco.so, .dylib or mujoco.dll) in {folder}")
    return ctypes.cast(ctypes.CDLL(str(found[0])).mj_step, ctypes.c_void_p).value


@intrinsic
def _step_physics(typingctx, function, model, data):
    def codegen(context, builder, signature, args):
        pointer = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [pointer, pointer])
        target = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(target, [builder.inttoptr(arg, pointer) for arg in args[1:]])
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), codegen


@intrinsic
def _as_pointer(typingctx, address):
    def codegen(context, builder, signature, args):
        return builder.inttoptr(args[0], context.get_value_type(signature.return_type))

    return types.CPointer(types.float64)(types.int64), codegen


@njit(cache=True, inline="always")
def _array(address, length):
    return carray(_as_pointer(address), (length,))


@njit(cache=True)
def _next_frame(axes, index, turn):
    """Writes frame ``index`` of the chain into ``axes`` (columns x, y, z) up to the joint's own rotation.

    ``turn`` is +1, -1 or 0: the fixed rotation about x by +90, -90 or 0 deg.
    """
    for k in range(3):
        x, y, z = axes[index - 1, 0, k], axes[index - 1, 1, k], axes[index - 1, 2, k]
        axes[index, 0, k] = x
        if turn > 0:
            axes[index, 1, k], axes[index, 2, k] = z, -y
        elif turn < 0:
            axes[index, 1, k], axes[index, 2, k] = -z, y
        else:
            axes[index, 1, k], axes[index, 2, k] = y, z


@njit(cache=True)
def _rotate(axes, index, angle):
    c, s = np.cos(angle), np.sin(angle)
    for k in range(3):
        x, y = axes[index, 0, k], axes[index, 1, k]
        axes[index, 0, k] = c * x + s * y
        axes[index, 1, k] = c * y - s * x


@njit(cache=True)
def forward_kinematics(q, axes, origins, tcp, quat):
    """Forward kinematics of the arm: frames of its joints and pose of the TCP, in the frame of its base.

    Args:
        q (np.ndarray): joint angles [7] (rad).
        axes (np.ndarray): receives the axes x, y, z of the joints' frames in rows 1-7 [8, 3, 3]; row 0 ends as the
            hand's.
        origins (np.ndarray): receives their origins [8, 3] (m).
        tcp (np.ndarray): receives the position of the TCP [3] (m).
        quat (np.ndarray): receives its quaternion [4] (w, x, y, z).
    """
    for i in range(3):
        for k in range(3):
            axes[0, i, k] = 1.0 if i == k else 0.0
    origins[0, 0], origins[0, 1], origins[0, 2] = 0.0, 0.0, 0.0
    for index in range(1, 8):
        along_x, along_y, along_z, turn = 0.0, 0.0, 0.0, 1
        if index == 1:
            along_z, turn = 0.333, 0
        elif index == 2:
            turn = -1
        elif index == 3:
            along_y = -0.316
        elif index == 4:
            along_x = 0.0825
        elif index == 5:
            along_x, along_y, turn = -0.0825, 0.384, -1
        elif index == 7:
            along_x = 0.088
        for k in range(3):
            origins[index, k] = (
                origins[index - 1, k]
                + axes[index - 1, 0, k] * along_x
                + axes[index - 1, 1, k] * along_y
                + axes[index - 1, 2, k] * along_z
            )
        _next_frame(axes, index, turn)
        _rotate(axes, index, q[index - 1])
    for k in range(3):
        tcp[k] = origins[7, k] + 0.212 * axes[7, 2, k]
        # the hand is turned by exactly -45 deg about z
        axes[0, 0, k] = _COS45 * (axes[7, 0, k] - axes[7, 1, k])
        axes[0, 1, k] = _COS45 * (axes[7, 0, k] + axes[7, 1, k])
        axes[0, 2, k] = axes[7, 2, k]
    _quaternion(axes[0], quat)


@njit(cache=True)
def _quaternion(axes, quat):
    """Quaternion (w, x, y, z) of a rotation whose columns are the rows of ``axes``."""
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
def inverse_kinematics(target, q, axes, origins, tcp, quat, jacobian, matrix, task, null, factor, vectors):
    """Inverse kinematics: moves joint angles in place, by three damped steps, towards a pose of the TCP.

    Args:
        target (np.ndarray): position (m) and unit quaternion (w, x, y, z) [7].
        q (np.ndarray): joint angles [7] (rad), overwritten.
        axes (np.ndarray): scratch space [8, 3, 3].
        origins (np.ndarray): scratch space [8, 3].
        tcp (np.ndarray): scratch space [3].
        quat (np.ndarray): scratch space [4].
        jacobian (np.ndarray): scratch space [6, 7].
        matrix (np.ndarray): scratch space [6, 6].
        task (np.ndarray): scratch space [6].
        null (np.ndarray): scratch space [7].
        factor (np.ndarray): scratch space [6, 6].
        vectors (np.ndarray): scratch space [6, 6].
    """
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
        solve_clipped(matrix, task, factor, vectors)

        square = 0.0
        for j in range(7):
            for i in range(6):
                null[j] += jacobian[i, j] * task[i]
            square += null[j] * null[j]
        scale = 3.0 / np.sqrt(square) if square > 9.0 else 1.0
        for j in range(7):
            q[j] = clip(q[j] + TIMESTEP * scale * null[j], Q_MIN[j], Q_MAX[j])


@njit(cache=True)
def _finger_forces(position, velocity, width, grasping, ctrl):
    mean = 0.5 * (position[7] + position[8])
    for i in range(7, 9):
        if mean - width > 0.005:
            hold = -20.0 if grasping else 10.0 * (-0.2 - velocity[i])
        else:
            hold = clip(500.0 * (width - position[i]) - 10.0 * velocity[i], -5.0, 5.0)
        ctrl[i] = 500.0 * (mean - position[i]) + hold


@njit(cache=True)
def _write_log(row, pointers, qpos, qvel, q_des, v_des, a_des, tcp, quat):
    """Log row of D3IL's recorder: joints after the substep, TCP pose at its beginning.

    The velocity mixes both as the original does: Jacobian of the beginning, joint velocities after the substep.
    """
    anchors, joint_axes = _array(pointers[ANCHORS], 21), _array(pointers[JOINT_AXES], 21)
    row[42:45] = 0.0
    for j in range(7):
        row[j], row[7 + j], row[14 + j], row[21 + j], row[28 + j] = qpos[j], qvel[j], q_des[j], v_des[j], a_des[j]
        zx, zy, zz = joint_axes[3 * j], joint_axes[3 * j + 1], joint_axes[3 * j + 2]
        rx, ry, rz = tcp[0] - anchors[3 * j], tcp[1] - anchors[3 * j + 1], tcp[2] - anchors[3 * j + 2]
        row[42] += qvel[j] * (zy * rz - zz * ry)
        row[43] += qvel[j] * (zz * rx - zx * rz)
        row[44] += qvel[j] * (zx * ry - zy * rx)
    row[35], row[36], row[37] = tcp[0], tcp[1], tcp[2]
    row[38], row[39], row[40], row[41] = quat[0], quat[1], quat[2], quat[3]
    row[45] = qpos[7] + qpos[8]
    objects = _array(pointers[OBJECTS], len(row) - LOG_WIDTH)
    for k in range(len(objects)):
        row[LOG_WIDTH + k] = objects[k]


@njit(nogil=True, cache=True)
def track_pose(step, model, data, pointers, rows, commands, widths, grasping, substeps, targets, speeds, started, log):
    """Tracks Cartesian commands for ``substeps`` physics steps in each of the simulations ``rows``.

    Args:
        step (int): address of ``mj_step``.
        model (int): address of the shared mjModel.
        data (np.ndarray): addresses of the mjData [n], int64.
        pointers (np.ndarray): addresses of their arrays [n, NUM_POINTERS], int64.
        rows (np.ndarray): indices of the simulations to advance, int64.
        commands (np.ndarray): TCP position (m) and quaternion [n, 7], float64.
        widths (np.ndarray): finger targets [n] (m).
        grasping (np.ndarray): whether the fingers press [n], bool.
        substeps (int): physics steps per control step.
        targets (np.ndarray): joint targets [n, 7], kept between calls.
        speeds (np.ndarray): joint target velocities [n, 7], kept between calls.
        started (np.ndarray): False where the controller has not run since the reset [n], bool.
        log (np.ndarray): receives one row per simulation after the first substep [n, LOG_WIDTH + 7 free bodies].
    """
    axes, origins = np.empty((8, 3, 3)), np.empty((8, 3))
    tcp, quat, target = np.empty(3), np.empty(4), np.empty(7)
    jacobian, matrix, factor, vectors = np.empty((6, 7)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    task, null, q, v, a = np.empty(6), np.empty(7), np.empty(7), np.empty(7), np.empty(7)
    for row in rows:
        qpos, qvel = _array(pointers[row, QPOS], 9), _array(pointers[row, QVEL], 9)
        ctrl, bias = _array(pointers[row, CTRL], 9), _array(pointers[row, BIAS], 9)
        norm = 0.0
        for k in range(3, 7):
            norm += commands[row, k] ** 2
        norm = np.sqrt(norm)
        for k in range(7):
            target[k] = commands[row, k] if k < 3 else commands[row, k] / norm
        for j in range(7):
            q[j] = targets[row, j] if started[row] else qpos[j]
            v[j] = speeds[row, j] if started[row] else 0.0
        started[row] = True
        for substep in range(substeps):
            for j in range(7):
                targets[row, j] = q[j]
                speeds[row, j] = v[j]
            inverse_kinematics(target, q, axes, origins, tcp, quat, jacobian, matrix, task, null, factor, vectors)
            for j in range(7):
                v[j] = (q[j] - targets[row, j]) / TIMESTEP
                a[j] = 0.4 * (v[j] - speeds[row, j]) / TIMESTEP  # logged by the original, used for nothing
                ctrl[j] = KP[j] * (q[j] - qpos[j]) + KD[j] * (v[j] - qvel[j]) + bias[j]
            _finger_forces(qpos, qvel, widths[row], grasping[row], ctrl)
            _step_physics(step, model, data[row])
            if substep == 0:
                tcp_now, quat_now = _array(pointers[row, TCP_POS], 3), _array(pointers[row, TCP_QUAT], 4)
                _write_log(log[row], pointers[row], qpos, qvel, q, v, a, tcp_now, quat_now)
        for j in range(7):
            targets[row, j] = q[j]
            speeds[row, j] = v[j]


@njit(nogil=True, cache=True)
def track_joints(step, model, data, pointers, rows, commands, widths, grasping, substeps, log):
    """Holds joint targets for ``substeps`` physics steps in each of the simulations ``rows``.

    Args:
        step (int): address of ``mj_step``.
        model (int): address of the shared mjModel.
        data (np.ndarray): addresses of the mjData [n], int64.
        pointers (np.ndarray): addresses of their arrays [n, NUM_POINTERS], int64.
        rows (np.ndarray): indices of the simulations to advance, int64.
        commands (np.ndarray): joint angles [n, 7] (rad), float64.
        widths (np.ndarray): finger targets [n] (m).
        grasping (np.ndarray): whether the fingers press [n], bool.
        substeps (int): physics steps per control step.
        log (np.ndarray): receives one row per simulation after the first substep, as in :func:`track_pose`.
    """
    zero = np.zeros(7)
    for row in rows:
        qpos, qvel = _array(pointers[row, QPOS], 9), _array(pointers[row, QVEL], 9)
        ctrl, bias = _array(pointers[row, CTRL], 9), _array(pointers[row, BIAS], 9)
        for substep in range(substeps):
            for j in range(7):
                ctrl[j] = KP[j] * (commands[row, j] - qpos[j]) - KD[j] * qvel[j] + bias[j]
            _finger_forces(qpos, qvel, widths[row], grasping[row], ctrl)
            _step_physics(step, model, data[row])
            if substep == 0:
                tcp_now, quat_now = _array(pointers[row, TCP_POS], 3), _array(pointers[row, TCP_QUAT], 4)
                _write_log(log[row], pointers[row], qpos, qvel, commands[row], zero, zero, tcp_now, quat_now)
