# This source code is licensed under the MIT license found in the LICENSE file.
"""What D3IL's recorder would log of a control step."""

from __future__ import annotations

import numpy as np

from torchrl_koap.envs.mujoco import controller
from torchrl_koap.envs.mujoco.simulation import SimulationBatch
from torchrl_koap.tasks import Task


class RawLog:
    """Base of :class:`~torchrl_koap.envs.base.ManipulationEnv`: its last control step in D3IL's layout.

    Reads ``sims`` (:class:`~torchrl_koap.envs.mujoco.simulation.SimulationBatch`), ``commands`` and ``task``.

    Examples:
        >>> from torchrl_koap.envs import AvoidingEnv
        >>> env = AvoidingEnv(num_envs=2)
        >>> env.rollout(2)["action"].shape, env.raw_log()["j_pos"].shape
        (torch.Size([2, 2, 2]), (2, 7))
    """

    sims: SimulationBatch
    commands: np.ndarray
    task: Task

    def raw_log(self) -> dict[str, np.ndarray]:
        """What D3IL's recorder logs for the last control step, one row per environment (docs/d3il.md, Recordings).

        The recorder looks after the *first* substep, so ``c_pos`` (m) is the TCP at the start of the step and
        ``des_c_pos`` the command of that step. Joints in rad, velocities in rad/s and m/s, ``time_stamp`` in s.

        Returns:
            dict: ``j_pos, j_vel, des_j_pos, des_j_vel, des_j_acc`` [n, 7], ``c_pos, c_vel, des_c_pos`` [n, 3],
            ``c_quat, des_c_quat`` [n, 4], ``gripper_width, sim_step, time_stamp`` [n].
        """
        row = {name: self.sims.log[:, columns].copy() for name, columns in controller.LOG_COLUMNS.items()}
        row["gripper_width"] = row["gripper_width"][:, 0]
        row |= self.logged_command()
        row["time_stamp"] = self.sims.log_time.copy()
        row["sim_step"] = np.rint(self.sims.log_time / controller.TIMESTEP).astype(np.int64)
        return row

    def logged_command(self) -> dict[str, np.ndarray]:
        """The command as the recorder names it, where the controller's log does not hold it."""
        return {"des_c_pos": self.commands[:, :3], "des_c_quat": self.commands[:, 3:7]}

    def raw_objects(self) -> dict[str, np.ndarray]:
        """Poses of the task's objects as D3IL's recorder logs them, after the first substep of the last control step.

        Returns:
            dict: pose [n, 7] (m, quaternion) per object, in the order and with the names of ``task.objects``.
        """
        poses = self.sims.log[:, controller.LOG_WIDTH :].reshape(len(self.sims), -1, 7)
        return {name: poses[:, index].copy() for index, name in enumerate(self.task.objects[: poses.shape[1]])}
