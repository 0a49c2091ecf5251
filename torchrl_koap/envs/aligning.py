# This source code is licensed under the MIT license found in the LICENSE file.
"""Aligning: push a tray, from inside or outside its walls, into a target pose (docs/appendix/d3il.md, Aligning)."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.contexts import poses_of
from torchrl_koap.envs.mujoco.scene import panda, scene
from torchrl_koap.tasks.aligning import BASE_HALF, DISTANCE_TOLERANCE, ROTATION_TOLERANCE

INSIDE_REACH = 0.051  # m; the rod is inside the tray if nearer to its centre than this
# name, direction from the centre, colour
WALLS = (
    ("wall_right", (1, 0), (0, 0, 1, 1)),
    ("wall_far", (0, 1), (0, 1, 0, 1)),
    ("wall_left", (-1, 0), (1, 0, 0, 1)),
    ("wall_near", (0, -1), (0, 1, 1, 1)),
)


def aligned(tray: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Returns whether poses ``[..., 7]`` (m, quaternion) agree: distance in x, y, z and angle are small."""
    distance = np.linalg.norm(tray[..., :3] - target[..., :3], axis=-1)
    same = np.abs((tray[..., 3:] * target[..., 3:]).sum(-1))
    angle = 2 * np.arccos(np.minimum(same, 1.0)) / np.pi
    return (distance <= DISTANCE_TOLERANCE) & (angle <= ROTATION_TOLERANCE)


class AligningEnv(ManipulationEnv):
    """Aligning of D3IL as a native-batch TorchRL environment on MuJoCo.

    =============== ========= ================= ===============================================================
    key             shape     dtype             meaning
    =============== ========= ================= ===============================================================
    ``observation`` [n, 20]   ``dtype``         0-2 last commanded TCP xyz, 3-5 measured TCP xyz, 6-8 tray position
                                                (m), 9-12 tray quaternion, 13-15 target position, 16-19 target
                                                quaternion; after a reset the commanded xyz is the measured one
    ``action``      [n, 3]    ``dtype``         change of the commanded TCP xyz (m)
    ``success``     [n, 1]    bool              the tray is in the target pose, see :func:`aligned`
    ``mode``        [n, 1]    int64             0 pushed from inside, 1 from outside, -1 before the first step
    ``context``     [n, 2, 3] ``dtype``         start of the tray, and target: x, y (m), yaw (rad)
    =============== ========= ================= ===============================================================

    There is no failure. Exact alignment counts as success; in the original its rotation distance becomes NaN.

    Args, errors and the order of events are those of :class:`~torchrl_koap.envs.base.ManipulationEnv`.

    Examples:
        >>> from torchrl_koap.envs import AligningEnv
        >>> env = AligningEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 20])
    """

    TASK = "aligning"
    START_JOINTS = (
        -0.39275835987073354,
        0.32177812339570716,
        -0.21250285252375792,
        -1.843581356712203,
        0.0831488803864002,
        2.160344058282072,
        0.144795218196799,
    )
    MODE_VALUES = 2

    def _begin(self, rows: np.ndarray) -> None:
        super()._begin(rows)
        for row, pose in zip(rows, self.targets[rows], strict=True):
            self.sims.data[row].mocap_pos[0], self.sims.data[row].mocap_quat[0] = pose[:3], pose[3:]
            self.sims.set_state(row, self.sims.get_state(row))  # or the first picture would show the old target

    def _observe(self, rows: np.ndarray) -> np.ndarray:
        parts = (self._commands[:, :3], self.sims.tcp_position, self.sims.object_poses[:, 0], self.targets)
        return np.concatenate([part[rows] for part in parts], axis=1)

    @property
    def targets(self) -> np.ndarray:
        """Target poses [n, 7]: position (m) and quaternion."""
        return poses_of(self._contexts[:, 1], height=0.0)

    def _check(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return aligned(self.sims.object_poses[rows, 0], self.targets[rows]), np.zeros(len(rows), dtype=bool)

    def _update_mode(self, rows: np.ndarray) -> None:
        gap = self.sims.tcp_position[rows, :2] - self.sims.object_poses[rows, 0, :2]
        self._mode[rows, 0] = np.linalg.norm(gap, axis=1) >= INSIDE_REACH

    def raw_log(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Returns what D3IL's recorder logs, with the target among the objects."""
        robot, tray = super().raw_log()
        return robot, np.concatenate([tray, self.targets[:, None]], axis=1)

    def _scene(self) -> Any:
        root = scene()
        tray = root.worldbody.add("body", name="box")
        tray.add("freejoint", name="box")
        base = {"size": (BASE_HALF, BASE_HALF, 0.01), "type": "box", "rgba": (0.8, 0.655, 0.45, 1)}
        tray.add("geom", name="base", mass=1.0, friction=(0.3, 0.001, 0.0001), priority=1, **base)
        target = root.worldbody.add("body", name="target", mocap=True)
        target.add("site", name="target_base", **base | {"rgba": (0.8, 0.655, 0.45, 0.5)})
        for name, (x, y), colour in WALLS:
            size = (0.005, BASE_HALF, 0.045) if x else (BASE_HALF, 0.005, 0.045)
            wall = {"type": "box", "size": size, "pos": (x * BASE_HALF, y * BASE_HALF, 0.0485)}
            tray.add("geom", name=name, mass=0.001, rgba=colour, **wall)
            target.add("site", name=f"target_{name}", rgba=(*colour[:3], 0.4), **wall)
        root.attach(panda())
        return root
