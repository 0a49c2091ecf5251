# This source code is licensed under the MIT license found in the LICENSE file.
"""What of a running episode can be saved, restored, and logged in D3IL's layout."""

from __future__ import annotations

import numpy as np

from torchrl_koap.envs.mujoco import controller


class Snapshots:
    """Methods of :class:`~torchrl_koap.envs.base.ManipulationEnv` that look at one moment of its episodes."""

    def get_state(self, index: int) -> dict:
        """Full state of one environment: simulation, controller, command, mode, outcome and step count.

        Args:
            index (int): which environment.

        Returns:
            dict: arrays for :meth:`set_state`; also valid in another environment of the same task.
        """
        names = (
            "_observation",
            "_commands",
            "_mode",
            "_success",
            "_collision",
            "_seen",
            "_steps",
            "_ready",
            "_contexts",
        )
        return {"simulation": self.sims.get_state(index)} | {n: np.copy(getattr(self, n)[index]) for n in names}

    def set_state(self, index: int, state: dict) -> None:
        """Restores what :meth:`get_state` returned; the episode then continues bit for bit."""
        self.sims.set_state(index, state["simulation"])
        for name, value in state.items():
            if name != "simulation":
                getattr(self, name)[index] = value

    def set_physics(self, index: int, qpos, qvel=None, *, qacc_warmstart=None, ctrl=None, time: float = 0.001) -> None:
        """Starts a fresh episode of one environment from a given physics state.

        Args:
            index (int): which environment; its context stays.
            qpos (array): positions [nq] (m, rad).
            qvel (array, optional): velocities [nv]; zero if not given.
            qacc_warmstart (array, optional): warm start of the solver [nv].
            ctrl (array, optional): motor commands of the substep before [nu].
            time (float): clock (s).

        Raises:
            ValueError: if a size is wrong.
        """
        self.sims.set_physics(index, qpos, qvel, qacc_warmstart=qacc_warmstart, ctrl=ctrl, time=time)
        self.sims.widths[index] = controller.FINGER_OPEN
        self._begin_episode(np.array([index]))

    def raw_log(self) -> dict[str, np.ndarray]:
        """What D3IL's recorder logs for the last control step, one row per environment (spec section 9).

        The recorder looks after the *first* substep, so ``c_pos`` (m) is the TCP at the start of the step and
        ``des_c_pos`` the command of that step. Joints in rad, velocities in rad/s and m/s, ``time_stamp`` in s.

        Returns:
            dict: ``j_pos, j_vel, des_j_pos, des_j_vel, des_j_acc`` [n, 7], ``c_pos, c_vel, des_c_pos`` [n, 3],
            ``c_quat, des_c_quat`` [n, 4], ``gripper_width, sim_step, time_stamp`` [n].
        """
        row = {name: self.sims.log[:, columns].copy() for name, columns in controller.LOG_COLUMNS.items()}
        row["gripper_width"] = row["gripper_width"][:, 0]
        row |= self._logged_command()
        row["time_stamp"] = self.sims.log_time.copy()
        row["sim_step"] = np.rint(self.sims.log_time / controller.TIMESTEP).astype(np.int64)
        return row

    def _logged_command(self) -> dict[str, np.ndarray]:
        return {"des_c_pos": self._commands[:, :3].copy(), "des_c_quat": self._commands[:, 3:7].copy()}

    def raw_objects(self) -> dict[str, np.ndarray]:
        """Poses of the task's objects as D3IL's recorder logs them, after the first substep of the last control step.

        Returns:
            dict: pose [n, 7] (m, quaternion) per object, in the order and with the names of ``task.objects``.
        """
        poses = self.sims.log[:, controller.LOG_WIDTH :].reshape(len(self.sims), -1, 7)
        return {name: poses[:, index].copy() for index, name in enumerate(self.task.objects[: poses.shape[1]])}
