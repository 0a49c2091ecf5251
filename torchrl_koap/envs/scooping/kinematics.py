# This source code is licensed under the MIT license found in the LICENSE file.
"""Inverse kinematics of the Panda that holds Scooping's spoon."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_koap.envs.scooping.scene import scooping_model

REST = np.array([0.0, 0.1, 0.0, -2.3, 0.0, 2.4, 0.785])  # rad; the pose that is kept near to
_DAMPING, _PULL = 1e-4, 0.05


def rotation_of(yaw: float, pitch: float, roll: float = 0.0) -> np.ndarray:
    """Computes the axes of a spoon ``[3, 3]``, in columns.

    It is turned by yaw, then by pitch about the turned y, positive nose down, then by roll about the turned x (rad).
    """
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(angle), np.sin(angle)) for angle in (yaw, pitch, roll))
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    return about_z @ about_y @ about_x


class SpoonKinematics:
    """Joints that bring the spoon to a pose, near to those it has now and to a rest pose."""

    def __init__(self):
        self._model = scooping_model("robot", pieces=False)
        self._data = mujoco.MjData(self._model)
        self._site = self._model.site("spoon").id
        self.low, self.high = self._model.jnt_range.T + np.array([[0.02], [-0.02]])
        self._jacobian = np.zeros((6, 7))

    def _forward(self, joints: np.ndarray) -> None:
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)

    def position(self, joints: np.ndarray) -> np.ndarray:
        """Computes the position of the spoon ``[3]`` (m) with joints ``[7]`` (rad)."""
        self._forward(joints)
        return self._data.site_xpos[self._site].copy()

    def solve(
        self, position: np.ndarray, rotation: np.ndarray, joints: np.ndarray | None = None, iterations: int = 40
    ) -> np.ndarray:
        """Finds joints ``[7]`` (rad) at which the spoon has a pose.

        Args:
            position (np.ndarray): of the spoon ``[3]`` (m).
            rotation (np.ndarray): its axes in columns ``[3, 3]``.
            joints (np.ndarray, optional): where to begin ``[7]``. Default: the rest pose.
            iterations (int): steps at most.
        """
        joints = (REST if joints is None else joints).copy()
        for _ in range(iterations):
            self._forward(joints)
            now = self._data.site_xmat[self._site].reshape(3, 3)
            turn = 0.5 * np.cross(now.T, rotation.T).sum(0)
            error = np.concatenate([position - self._data.site_xpos[self._site], turn])
            mujoco.mj_jacSite(self._model, self._data, self._jacobian[:3], self._jacobian[3:], self._site)
            weighted = self._jacobian.T @ np.linalg.inv(self._jacobian @ self._jacobian.T + _DAMPING * np.eye(6))
            rest = _PULL * (REST - joints)
            change = weighted @ error + rest - weighted @ (self._jacobian @ rest)
            joints = np.clip(joints + np.clip(change, -0.2, 0.2), self.low, self.high)
            if np.abs(error).max() < 2e-4 and np.abs(change).max() < 2e-3:
                break
        return joints
