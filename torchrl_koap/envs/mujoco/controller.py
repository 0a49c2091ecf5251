# This source code is licensed under the MIT license found in the LICENSE file.
"""Compiled controller: inverse kinematics, joint PD, finger force each millisecond (docs/appendix/d3il.md, Controller).

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

from torchrl_koap.envs.mujoco.kinematics import TIMESTEP, clip, inverse_kinematics

KP = np.array([120.0, 120.0, 120.0, 120.0, 50.0, 30.0, 10.0])
KD = np.array([10.0, 10.0, 10.0, 10.0, 6.0, 5.0, 3.0])
FINGER_OPEN = 0.04
FINGER_RESET = 0.001

# Columns of the pointer table: addresses of one simulation's arrays inside its mjData.
QPOS, QVEL, CTRL, BIAS, TCP_POS, OBJECTS = range(6)
# Columns of the log row written after the first substep of a control step; the free bodies' poses follow them.
LOG_COLUMNS = {"j_pos": slice(0, 7), "des_j_pos": slice(7, 14), "c_pos": slice(14, 17), "gripper_width": 17}
LOG_WIDTH = 18


@functools.cache
def step_address() -> int:
    """Returns the address of ``mj_step`` in the library beside the ``mujoco`` package, which must be there."""
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
def _finger_forces(position, velocity, width, grasping, ctrl):
    mean = 0.5 * (position[7] + position[8])
    for i in range(7, 9):
        if mean - width > 0.005:
            hold = -20.0 if grasping else 10.0 * (-0.2 - velocity[i])
        else:
            hold = clip(500.0 * (width - position[i]) - 10.0 * velocity[i], -5.0, 5.0)
        ctrl[i] = 500.0 * (mean - position[i]) + hold


@njit(cache=True)
def _write_log(row, pointers, qpos, q_des):
    """Log row of D3IL's recorder: joints after the substep, TCP position at its beginning."""
    row[:7], row[7:14] = qpos[:7], q_des
    row[14:17] = _array(pointers[TCP_POS], 3)
    row[17] = qpos[7] + qpos[8]
    row[LOG_WIDTH:] = _array(pointers[OBJECTS], len(row) - LOG_WIDTH)


@njit(nogil=True, cache=True)
def track_pose(step, model, data, pointers, rows, commands, widths, grasping, substeps, targets, started, log):
    """Tracks Cartesian commands for ``substeps`` physics steps in each of the simulations ``rows``.

    ``step`` is the address of ``mj_step``, ``model`` that of the shared mjModel, ``data`` [n] are those of the mjData
    and ``pointers`` [n, 6] those of their arrays. ``commands`` [n, 7] are TCP positions (m) and quaternions, ``widths``
    [n] finger targets (m), ``grasping`` [n] says whether the fingers press. Kept between calls: joint ``targets``
    [n, 7], and ``started`` [n], False where the controller has not run since the reset. The first substep is written
    into ``log`` [n, LOG_WIDTH + 7 free bodies].
    """
    target, q = np.empty(7), np.empty(7)
    for row in rows:
        qpos, qvel = _array(pointers[row, QPOS], 9), _array(pointers[row, QVEL], 9)
        ctrl, bias = _array(pointers[row, CTRL], 9), _array(pointers[row, BIAS], 9)
        norm = 0.0
        for k in range(3, 7):
            norm += commands[row, k] ** 2
        norm = np.sqrt(norm)
        for k in range(7):
            target[k] = commands[row, k] if k < 3 else commands[row, k] / norm
        q[:] = targets[row] if started[row] else qpos[:7]
        started[row] = True
        for substep in range(substeps):
            targets[row] = q
            inverse_kinematics(target, q)
            for j in range(7):
                speed = (q[j] - targets[row, j]) / TIMESTEP
                ctrl[j] = KP[j] * (q[j] - qpos[j]) + KD[j] * (speed - qvel[j]) + bias[j]
            _finger_forces(qpos, qvel, widths[row], grasping[row], ctrl)
            _step_physics(step, model, data[row])
            if substep == 0:
                _write_log(log[row], pointers[row], qpos, q)
        targets[row] = q


@njit(nogil=True, cache=True)
def track_joints(step, model, data, pointers, rows, commands, widths, grasping, substeps, log):
    """Holds joints at ``commands`` [n, 7] (rad) for ``substeps`` physics steps; as :func:`track_pose` else."""
    for row in rows:
        qpos, qvel = _array(pointers[row, QPOS], 9), _array(pointers[row, QVEL], 9)
        ctrl, bias = _array(pointers[row, CTRL], 9), _array(pointers[row, BIAS], 9)
        for substep in range(substeps):
            for j in range(7):
                ctrl[j] = KP[j] * (commands[row, j] - qpos[j]) - KD[j] * qvel[j] + bias[j]
            _finger_forces(qpos, qvel, widths[row], grasping[row], ctrl)
            _step_physics(step, model, data[row])
            if substep == 0:
                _write_log(log[row], pointers[row], qpos, commands[row])
