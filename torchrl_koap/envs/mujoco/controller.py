# This source code is licensed under the MIT license found in the LICENSE file.
"""Compiled controller: inverse kinematics, joint PD, finger force each millisecond (docs/appendix/d3il.md, Controller).

One call advances a simulation by all substeps of a control step without returning to Python: the compiled loop
computes the motor commands and calls ``mj_step`` of the MuJoCo library through its address. It releases the
interpreter lock, so calls for different simulations run in parallel threads. Compiled code is cached on disk by numba.

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
def _substep(step, model, data, pointers, q, speed, width, grasping, log, logged):
    """Runs one physics step of one simulation with joints pulled to ``q`` [7] (rad) at ``speed`` [7] (rad/s).

    If ``logged``, writes a log row as D3IL's recorder: joints after the step, TCP position at its beginning.
    """
    qpos, qvel = _array(pointers[QPOS], 9), _array(pointers[QVEL], 9)
    ctrl, bias = _array(pointers[CTRL], 9), _array(pointers[BIAS], 9)
    for j in range(7):
        ctrl[j] = KP[j] * (q[j] - qpos[j]) + KD[j] * (speed[j] - qvel[j]) + bias[j]
    mean = 0.5 * (qpos[7] + qpos[8])
    for j in range(7, 9):
        if mean - width > 0.005:
            hold = -20.0 if grasping else 10.0 * (-0.2 - qvel[j])
        else:
            hold = clip(500.0 * (width - qpos[j]) - 10.0 * qvel[j], -5.0, 5.0)
        ctrl[j] = 500.0 * (mean - qpos[j]) + hold
    _step_physics(step, model, data)
    if logged:
        log[:7], log[7:14] = qpos[:7], q
        log[14:17] = _array(pointers[TCP_POS], 3)
        log[17] = qpos[7] + qpos[8]
        log[LOG_WIDTH:] = _array(pointers[OBJECTS], len(log) - LOG_WIDTH)


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
        norm = 0.0
        for k in range(3, 7):
            norm += commands[row, k] ** 2
        norm = np.sqrt(norm)
        for k in range(7):
            target[k] = commands[row, k] if k < 3 else commands[row, k] / norm
        q[:] = targets[row] if started[row] else _array(pointers[row, QPOS], 7)
        started[row] = True
        fixed, hand = (step, model, data[row], pointers[row]), (widths[row], grasping[row], log[row])
        for substep in range(substeps):
            targets[row] = q
            inverse_kinematics(target, q)
            _substep(*fixed, q, (q - targets[row]) / TIMESTEP, *hand, substep == 0)
        targets[row] = q


@njit(nogil=True, cache=True)
def track_joints(step, model, data, pointers, rows, commands, widths, grasping, substeps, log):
    """Holds joints at ``commands`` [n, 7] (rad) for ``substeps`` physics steps; otherwise as :func:`track_pose`."""
    still = np.zeros(7)
    for row in rows:
        fixed, hand = (step, model, data[row], pointers[row]), (widths[row], grasping[row], log[row])
        for substep in range(substeps):
            _substep(*fixed, commands[row], still, *hand, substep == 0)
