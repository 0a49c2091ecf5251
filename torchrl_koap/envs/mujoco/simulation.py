# This source code is licensed under the MIT license found in the LICENSE file.
"""A batch of simulations of one scene: one shared model, one state per simulation, threads that advance them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np

from torchrl_koap.envs.mujoco import controller
from torchrl_koap.envs.mujoco.scene import PANDA

_NUM_JOINTS = 9  # seven of the arm, two fingers
_CHUNKS_PER_THREAD = 4  # smaller pieces balance simulations of unequal duration
_PHYSICS = mujoco.mjtState.mjSTATE_INTEGRATION.value


class Simulations:
    """Simulations that share a model and are advanced together, by several threads or by the caller's.

    The result for one simulation depends neither on the others nor on the number of threads.
    """

    _episode: dict[str, np.ndarray]  # state outside the physics, a row per simulation

    def __init__(self, model: mujoco.MjModel, num_sims: int, num_threads: int = 1):
        self.model, self.num_threads = model, num_threads
        self.data = [mujoco.MjData(model) for _ in range(num_sims)]
        before = set(vars(self))
        self._connect()
        self._connected = set(vars(self)) - before

    def _connect(self) -> None:
        """Sets attributes that copies and unpickled objects must not share but set anew."""
        self._executor: ThreadPoolExecutor | None = None
        self._executor_pid: int | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name not in self._connected}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._connect()

    def __len__(self) -> int:
        return len(self.data)

    def _run(self, advance: Callable[[np.ndarray], None], rows: np.ndarray, substeps: int) -> None:
        """Advances the simulations ``rows`` by ``substeps``, in threads if there are several of both."""
        timestep = self.model.opt.timestep
        due = [self.data[row].time + substeps * timestep for row in rows]
        if self.num_threads == 1 or len(rows) <= 1:
            advance(rows)
        else:
            if self._executor is None or self._executor_pid != os.getpid():  # threads do not survive a fork
                self._executor = ThreadPoolExecutor(self.num_threads, thread_name_prefix="koap-simulation")
                self._executor_pid = os.getpid()
            pieces = np.array_split(rows, min(len(rows), self.num_threads * _CHUNKS_PER_THREAD))
            for future in [self._executor.submit(advance, piece) for piece in pieces]:
                future.result()
        for row, time in zip(rows, due, strict=True):
            if abs(self.data[row].time - time) > 0.5 * timestep:  # MuJoCo resets a state that diverges
                raise RuntimeError(f"the simulation of environment {row} became unstable")

    def get_state(self, row: int) -> dict[str, np.ndarray]:
        """Returns the complete state of one simulation."""
        physics = np.empty(mujoco.mj_stateSize(self.model, _PHYSICS))
        mujoco.mj_getState(self.model, self.data[row], physics, _PHYSICS)
        return {"physics": physics} | {name: array[row].copy() for name, array in self._episode.items()}

    def set_state(self, row: int, state: dict[str, np.ndarray]) -> None:
        """Restores what :meth:`get_state` returned; the simulation then continues bit for bit."""
        data = self.data[row]
        mujoco.mj_resetData(self.model, data)
        mujoco.mj_setState(self.model, data, state["physics"], _PHYSICS)
        mujoco.mj_forward(self.model, data)  # poses for pictures, and contacts; the next line restores what it changes
        mujoco.mj_setState(self.model, data, state["physics"], _PHYSICS)
        for name, array in self._episode.items():
            array[row] = state[name]

    def close(self) -> None:
        """Ends the threads; they start again when needed."""
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


class SimulationBatch(Simulations):
    """Simulations of D3IL's arm under its controller, in a :func:`~torchrl_koap.envs.mujoco.scene.scene`."""

    def __init__(self, model: mujoco.MjModel, num_sims: int, num_threads: int = 1):
        joint = model.joint(f"{PANDA}joint1")
        self._qpos_start, self._qvel_start = int(joint.qposadr[0]), int(joint.dofadr[0])
        if (self._qpos_start, self._qvel_start) != (model.nq - _NUM_JOINTS, model.nv - _NUM_JOINTS):
            raise ValueError("the arm's nine joints must come last in the state, after the free bodies of the task")
        self._tcp = model.body(f"{PANDA}tcp").id
        super().__init__(model, num_sims, num_threads)
        self.joint_targets = np.zeros((num_sims, 7))
        self.started = np.zeros(num_sims, dtype=bool)
        self.widths = np.full(num_sims, controller.FINGER_RESET)
        self.grasping = np.zeros(num_sims, dtype=bool)
        self._episode = {"joint_targets": self.joint_targets, "started": self.started}
        self._episode |= {"width": self.widths, "grasping": self.grasping}
        self._log = np.zeros((num_sims, controller.LOG_WIDTH + model.nq - _NUM_JOINTS))

    def _connect(self) -> None:
        super()._connect()
        self._step = controller.step_address()
        self._data_addresses = np.array([data._address for data in self.data], dtype=np.int64)
        self._pointers = np.array([self._arrays(data) for data in self.data], dtype=np.int64)
        self._tcp_views = [data.xpos[self._tcp] for data in self.data]
        self._arm_views = [data.qpos[self._qpos_start :] for data in self.data]
        self._object_views = [data.qpos[: self._qpos_start] for data in self.data]

    def _arrays(self, data: mujoco.MjData) -> list[int]:
        """Returns the addresses that the controller reads and writes, in the order of its pointer table."""
        joints, speeds = data.qpos[self._qpos_start :], data.qvel[self._qvel_start :]
        bias, tcp = data.qfrc_bias[self._qvel_start :], data.xpos[self._tcp]
        return [array.ctypes.data for array in (joints, speeds, data.ctrl, bias, tcp, data.qpos)]

    @property
    def tcp_position(self) -> np.ndarray:
        """TCP positions [n, 3] (m) as the original reads them: one substep (1 ms) older than the joints."""
        return np.stack(self._tcp_views)

    @property
    def joint_positions(self) -> np.ndarray:
        """Measured joints [n, 7] (rad)."""
        return np.stack(self._arm_views)[:, :7]

    @property
    def gripper_width(self) -> np.ndarray:
        """Distance of the fingers [n] (m)."""
        return np.stack(self._arm_views)[:, 7:].sum(1)

    @property
    def object_poses(self) -> np.ndarray:
        """Poses of the free bodies [n, objects, 7]: position (m) and quaternion, in the order of the state."""
        return np.stack(self._object_views).reshape(len(self), -1, 7)

    def reset(
        self, rows: np.ndarray, start_joints: np.ndarray, object_poses: np.ndarray | None, *, width: float
    ) -> None:
        """Puts simulations into their start state (docs/appendix/d3il.md, Reset), one substep included.

        The arm gets ``start_joints`` [7] (rad), the free bodies, if there are any, ``object_poses`` [len(rows),
        objects, 7], the fingers the target ``width`` (m) during that substep.
        """
        commands = np.zeros((len(self), 7))
        for index, row in enumerate(rows):
            data = self.data[row]
            mujoco.mj_resetData(self.model, data)
            if object_poses is not None:
                data.qpos[: self._qpos_start] = object_poses[index].ravel()
            data.qpos[self._qpos_start : self._qpos_start + 7] = start_joints
            data.qpos[self._qpos_start + 7 :] = 0.0
            mujoco.mj_forward(self.model, data)
            commands[row] = start_joints
        self.started[rows] = False
        self.widths[rows] = width
        self.grasping[rows] = False
        self.track_joints(rows, commands, substeps=1)
        self.widths[rows] = controller.FINGER_OPEN

    def track_pose(self, rows: np.ndarray, commands: np.ndarray, substeps: int) -> None:
        """Advances simulations by ``substeps`` while the TCP follows ``commands`` [n, 7] (position, quaternion)."""
        self._track(controller.track_pose, rows, commands, substeps, self.joint_targets, self.started)

    def track_joints(self, rows: np.ndarray, commands: np.ndarray, substeps: int) -> None:
        """Advances simulations by ``substeps`` while the joints are held at ``commands`` [n, 7] (rad)."""
        self._track(controller.track_joints, rows, commands, substeps)

    def _track(self, kernel: Callable[..., None], rows, commands, substeps: int, *state: np.ndarray) -> None:
        commands = np.ascontiguousarray(commands, dtype=np.float64)
        fixed = (self._step, self.model._address, self._data_addresses, self._pointers)
        arguments = (commands, self.widths, self.grasping, substeps, *state, self._log)
        rows = np.ascontiguousarray(rows, dtype=np.int64)
        self._run(lambda piece: kernel(*fixed, piece, *arguments), rows, substeps)

    def get_state(self, row: int) -> dict[str, np.ndarray]:
        """Returns the complete state of one simulation, controller included."""
        data = self.data[row]
        read = {"bias": data.qfrc_bias.copy(), "tcp_position": data.xpos[self._tcp].copy()}
        return super().get_state(row) | read

    def set_state(self, row: int, state: dict[str, np.ndarray]) -> None:
        """Restores what :meth:`get_state` returned; the simulation then continues bit for bit."""
        super().set_state(row, state)
        data = self.data[row]
        data.qfrc_bias[:] = state["bias"]
        data.xpos[self._tcp] = state["tcp_position"]

    def logged(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Returns what D3IL's recorder logs for the last control step (docs/appendix/d3il.md, Recordings).

        It records after the *first* substep: ``c_pos`` (m) is the TCP at the beginning of the step. Joints are in rad;
        all are arrays ``[n, ...]``. The second value holds poses of the free bodies [n, objects, 7] (m, quaternion).
        """
        robot = {name: self._log[:, columns].copy() for name, columns in controller.LOG_COLUMNS.items()}
        return robot, self._log[:, controller.LOG_WIDTH :].reshape(len(self), -1, 7).copy()

    def contacts(self, row: int, geom: int, others: Sequence[int]) -> np.ndarray:
        """Returns which of the geoms ``others`` touched ``geom`` in the last substep, bool [len(others)]."""
        data = self.data[row]
        if not data.ncon:
            return np.zeros(len(others), dtype=bool)
        pairs = data.contact.geom
        touching = np.concatenate([pairs[pairs[:, 0] == geom, 1], pairs[pairs[:, 1] == geom, 0]])
        return np.isin(others, touching)
