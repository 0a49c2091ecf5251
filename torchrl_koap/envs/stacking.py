# This source code is licensed under the MIT license found in the LICENSE file.
"""Stacking: pile three boxes on a target zone with the gripper, in any order (docs/appendix/d3il.md, Stacking)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.mujoco import controller
from torchrl_koap.envs.mujoco.scene import add_free_box, panda, scene
from torchrl_koap.tasks import Task, get_task
from torchrl_koap.tasks.action_rules import OPEN, OPEN_ABOVE
from torchrl_koap.tasks.columns import tan_yaw
from torchrl_koap.tasks.modes import note_arrivals
from torchrl_koap.tasks.stacking import BOXES, TARGET, TARGET_HALF, ZONE_RADIUS, piled

COLOURS = {"red": (1, 0, 0, 1), "green": (0, 1, 0, 1), "blue": (0, 0, 1, 1)}
JOINT_BOUND = 0.03  # rad per control step


class StackingEnv(ManipulationEnv):
    """Stacking of D3IL as a native-batch TorchRL environment on MuJoCo.

    =============== ========= ================= ===============================================================
    key             shape     dtype             meaning
    =============== ========= ================= ===============================================================
    ``observation`` [n, 31]   ``dtype``         0-6 last commanded joints (rad), 7 last gripper command (m), 8-10 red
                                                box position (m), 11 its tan(yaw), 12-15 green, 16-19 blue, 20-26
                                                measured joints, 27 distance of the fingers (m), 28-30 TCP position;
                                                after a reset the commands are the measured joints and distance
    ``action``      [n, 8]    ``dtype``         0-6 change of the commanded joints (rad), 7 the gripper command itself
                                                (m): above 0.075 the fingers open, else they close and press
    ``success``     [n, 1]    bool              ``num_boxes`` boxes are in place, see below
    ``mode``        [n, 3]    int64             boxes in the order of their arrival: 0 red, 1 green, 2 blue, -1 none
    =============== ========= ================= ===============================================================

    The first 20 columns of the observation are those of D3IL's recordings. A box has *arrived* once its centre has
    been within 6 cm (horizontally) of (0.5, 0.2), at most one box per control step. Success with ``num_boxes=3``: all
    three are within 6 cm now and their heights differ by more than 3 cm, whether or not the gripper still holds one;
    with 1 or 2: that many boxes have arrived. There is no failure.

    Args, errors and the order of events are those of :class:`~torchrl_koap.envs.base.ManipulationEnv`.

    Raises:
        ValueError: also for a number of boxes other than 1, 2 or 3.

    Examples:
        >>> from torchrl_koap.envs import StackingEnv
        >>> env = StackingEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 31])
    """

    SUBSTEPS = 30
    START_JOINTS = (
        -1.1708457375867388e-08,
        -0.043618586668494642,
        1.3201479763146580e-08,
        -2.1884211669990354,
        -5.9465223596397744e-09,
        2.1499041610538185,
        0.78539816721171052,
    )
    ACTION_BOUND = ((-JOINT_BOUND,) * 7 + (0.0,), (JOINT_BOUND,) * 7 + (OPEN,))
    MODE_ENTRIES, MODE_VALUES = None, 3
    COMMAND_DIM, RESET_WIDTH = 8, controller.FINGER_OPEN

    def __init__(self, *args: Any, num_boxes: int = 3, task: Task | None = None, **options: Any):
        if num_boxes not in (1, 2, 3):
            raise ValueError(f"num_boxes must be 1, 2 or 3 (boxes needed for success), got {num_boxes!r}")
        task = get_task("stacking_1" if num_boxes == 1 else "stacking") if task is None else task
        super().__init__(*args, task=task, **options)
        self.num_boxes = num_boxes

    def _begin(self, rows: np.ndarray) -> None:
        self._commands[rows, :7] = self.sims.joint_positions[rows]
        self._commands[rows, 7] = self.sims.gripper_width[rows]

    def _command(self, rows: np.ndarray, action: np.ndarray) -> None:
        self._commands[rows, :7] += action[:, :7]
        self._commands[rows, 7] = action[:, 7]
        opens = action[:, 7] > OPEN_ABOVE
        self.sims.widths[rows] = np.where(opens, controller.FINGER_OPEN, 0.0)
        self.sims.grasping[rows] = ~opens

    def _advance(self, rows: np.ndarray) -> None:
        self.sims.track_joints(rows, self._commands[:, :7], self.SUBSTEPS)

    def _observe(self, rows: np.ndarray) -> np.ndarray:
        poses = self.sims.object_poses[rows]
        boxes = np.concatenate([poses[..., :3], tan_yaw(poses[..., 3:])[..., None]], axis=-1).reshape(len(rows), -1)
        parts = (self.sims.joint_positions, self.sims.gripper_width[:, None], self.sims.tcp_position)
        return np.concatenate([self._commands[rows], boxes, *(part[rows] for part in parts)], axis=1)

    def _check(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.num_boxes < 3:
            success = self._mode[rows, self.num_boxes - 1] >= 0
        else:
            success = piled(torch.from_numpy(self.sims.object_poses[rows, :, :3])).numpy()
        return success, np.zeros(len(rows), dtype=bool)

    def _update_mode(self, rows: np.ndarray) -> None:
        distance = np.linalg.norm(self.sims.object_poses[rows, :, :2] - TARGET, axis=-1)
        orders = self._mode[rows]
        note_arrivals(orders, distance, distance <= ZONE_RADIUS)
        self._mode[rows] = orders

    def _scene(self) -> Any:
        root = scene()
        for name, half in BOXES:
            add_free_box(root, name, half, COLOURS[name])
        size = (TARGET_HALF, TARGET_HALF, 0.04)
        root.worldbody.add("site", name="target", type="box", pos=(*TARGET, 0), size=size, rgba=(1, 0.5, 0, 0.3))
        root.attach(panda(rod=False, alpha=1.0, link_collisions=True))
        return root
