# This source code is licensed under the MIT license found in the LICENSE file.
"""Sorting: push cubes over the far edge of a platform into bins of their colour (docs/appendix/d3il.md, Sorting)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.mujoco.scene import add_free_box, panda, scene
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.columns import tan_yaw
from torchrl_koap.tasks.modes import note_arrivals
from torchrl_koap.tasks.sorting import (
    BIN_WALLS,
    BIN_X,
    BIN_Y,
    BOX_HALF,
    COLOURS,
    PLATFORM_X,
    box_colours,
    in_bins,
    sorting_task,
)

PLATFORM_TOP = 0.1  # (m)
_RGB = ((1, 0, 0), (0, 0, 1))  # of red and blue


class SortingEnv(ManipulationEnv):
    """Sorting of D3IL as a native-batch TorchRL environment on MuJoCo.

    =============== ========= ================= ===============================================================
    key             shape     dtype             meaning
    =============== ========= ================= ===============================================================
    ``observation`` [n, 16]   ``dtype``         0-1 last commanded TCP xy, 2-3 measured TCP xy (m), then x, y (m)
                                                and tan(yaw) of red_1, red_2, blue_1, blue_2 (10 columns with two
                                                boxes, 22 with six); after a reset the commanded xy is the measured
                                                one
    ``action``      [n, 2]    ``dtype``         change of the commanded TCP xy (m); height and orientation are held
    ``success``     [n, 1]    bool              every box is in its bin, at the same time
    ``mode``        [n, 4]    int64             colours in order of arrival, 0 red, 1 blue, -1 not arrived yet (2 or
                                                6 columns with as many boxes)
    =============== ========= ================= ===============================================================

    There is no failure; a box that lies in the wrong bin stays there.

    Arrivals are noted as in the original, at most one per control step. Of boxes not noted yet, only the one nearest to
    the centre of its bin is checked. A noted box that leaves its bin stays noted.

    Args, errors and the order of events are those of :class:`~torchrl_koap.envs.base.ManipulationEnv`.

    Examples:
        >>> from torchrl_koap.envs import SortingEnv
        >>> env = SortingEnv(num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 16])
    """

    START_JOINTS = (
        -0.32682662579052857,
        0.24562566192918364,
        -0.20325276715633386,
        -1.952193734596577,
        0.06315052037105527,
        2.1955061347936957,
        0.22457584505012435,
    )
    MODE_ENTRIES, MODE_VALUES = None, 2
    START_HEIGHT = 0.05  # m; inside the platform, as in the original; the first steps push the boxes up

    def __init__(self, *args: Any, num_boxes: int = 4, task: Task | None = None, **options: Any):
        task = sorting_task(num_boxes) if task is None else task
        self._colours = np.array(box_colours(len(task.objects)))
        super().__init__(*args, task=task, **options)
        self._noted = self._episode["noted"]

    def _episode_arrays(self, num_envs: int) -> dict[str, np.ndarray]:
        noted = np.full((num_envs, len(self._colours)), -1)  # boxes in order of arrival, by their number in the state
        return super()._episode_arrays(num_envs) | {"noted": noted}

    def _begin(self, rows: np.ndarray) -> None:
        super()._begin(rows)
        self._noted[rows] = -1

    def _observe(self, rows: np.ndarray) -> np.ndarray:
        poses = self.sims.object_poses[rows]
        boxes = np.concatenate([poses[..., :2], tan_yaw(poses[..., 3:])[..., None]], axis=-1)
        return np.concatenate(
            [self._commands[rows, :2], self.sims.tcp_position[rows, :2], boxes.reshape(len(rows), -1)], axis=1
        )

    def _inside(self, rows: np.ndarray) -> np.ndarray:
        """Returns which boxes are in their bins, at any height, bool [len(rows), num_boxes]."""
        return in_bins(torch.from_numpy(self.sims.object_poses[rows, :, :2])).numpy()

    def _check(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._inside(rows).all(-1), np.zeros(len(rows), dtype=bool)

    def _update_mode(self, rows: np.ndarray) -> None:
        xy = self.sims.object_poses[rows, :, :2]
        centres = np.stack([np.take(BIN_X, self._colours), np.full(len(self._colours), BIN_Y)], axis=-1)
        distance = np.linalg.norm(xy - centres, axis=-1)
        orders = self._noted[rows]
        note_arrivals(orders, distance, self._inside(rows))
        self._noted[rows], self._mode[rows] = orders, np.where(orders < 0, -1, self._colours[orders])

    def _scene(self) -> Any:
        root = scene()
        for name, colour in zip(self.task.objects, self._colours.tolist(), strict=True):
            add_free_box(root, name, (BOX_HALF,) * 3, (*_RGB[colour], 1))
        root.attach(panda(link_collisions=True))
        # separate bodies after the boxes, as in the original: contacts are listed in the order of bodies
        platform = root.worldbody.add("body", name="platform", pos=((PLATFORM_X[0] + PLATFORM_X[1]) / 2, -0.1, 0))
        size, friction = (0.3, 0.3, PLATFORM_TOP), (0.3, 0.001, 0.0001)
        platform.add("geom", type="box", size=size, friction=friction, priority=1, rgba=(0.5, 0.5, 0.5, 0.5))
        for name, x, rgb in zip(COLOURS, BIN_X, _RGB, strict=True):
            bin_ = root.worldbody.add("body", name=f"{name}_bin", pos=(x, BIN_Y, 0))
            for across, along, width, depth in BIN_WALLS:  # far, left, right, near
                wall = {"pos": (across, along, 0), "size": (width, depth, 0.1), "rgba": (*rgb, 0.5)}
                bin_.add("geom", type="box", **wall)
        return root
