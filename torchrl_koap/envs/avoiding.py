# This source code is licensed under the MIT license found in the LICENSE file.
"""Avoiding: steer a rod between six cylinders to the finish, in any of 24 ways (docs/appendix/d3il.md, Avoiding)."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.mujoco.scene import PANDA, panda, scene
from torchrl_koap.tasks.avoiding import FINISH_Y, OBSTACLES, ROW_REACH, ROW_Y


class AvoidingEnv(ManipulationEnv):
    """Avoiding of D3IL as a native-batch TorchRL environment on MuJoCo.

    =============== ========= ================= ===============================================================
    key             shape     dtype             meaning
    =============== ========= ================= ===============================================================
    ``observation`` [n, 4]    ``dtype``         0-1 last commanded xy, 2-3 measured TCP xy (m); after a reset the
                                                commanded xy is the measured one
    ``action``      [n, 2]    ``dtype``         change of the commanded xy (m)
    ``success``     [n, 1]    bool              the rod has crossed y = 0.35 before any collision was seen
    ``collision``   [n, 1]    bool              the rod was seen touching a cylinder before it crossed
    ``mode``        [n, 9]    bool              which gaps were passed, of rows of 2, 3 and 4
    =============== ========= ================= ===============================================================

    Collisions are checked once per control step, as in the original, so brief touches in between are missed. Crossing
    the line while touching is a success.

    The commanded height stays at the TCP height after the reset, the orientation at (0, 1, 0, 0). Every episode starts
    in the same state. Human demonstrators move the command by at most 0.012 m per axis and step, the range of the
    action spec; larger actions are executed as they are.

    Args and errors are those of :class:`~torchrl_koap.envs.base.ManipulationEnv`.

    Examples:
        >>> import torch
        >>> from torchrl_koap.envs.avoiding import AvoidingEnv
        >>> env = AvoidingEnv(num_envs=2)
        >>> data = env.rollout(3, lambda td: td.set("action", torch.full((2, 2), 0.005)))
        >>> data["next", "observation"][0, -1, :2].sub(data["observation"][0, 0, :2]).mul(1e3).round().tolist()
        [15.0, 15.0]
    """

    TASK = "avoiding"
    START_JOINTS = (
        -0.3564086847191448,
        0.42944545403685397,
        -0.13501059530077486,
        -2.0546518930206963,
        0.0935782229157612,
        2.4807179407013367,
        0.23250675884944516,
    )
    MODE_ENTRIES, COLLIDES = 9, True

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        model = self.sims.model
        self._rod = model.geom(f"{PANDA}rod").id
        self._obstacles = np.array([model.geom(name).id for name, *_ in OBSTACLES])

    def _observe(self, rows: np.ndarray) -> np.ndarray:
        return np.concatenate([self._commands[rows, :2], self.sims.tcp_position[rows, :2]], axis=1)

    def _check(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        crossed = self.sims.tcp_position[rows, 1] > FINISH_Y
        touching = np.array([self.sims.contacts(row, self._rod, self._obstacles).any() for row in rows], dtype=bool)
        return crossed, touching

    def obstacle_contacts(self) -> np.ndarray:
        """Returns which cylinders the rod touches in the present state, bool [n, 6] in the order of ``OBSTACLES``."""
        return np.stack([self.sims.contacts(row, self._rod, self._obstacles) for row in range(len(self.sims))])

    def _update_mode(self, rows: np.ndarray) -> None:
        x, y = self.sims.tcp_position[rows, 0], self.sims.tcp_position[rows, 1]
        mode, first = self._mode[rows], 0
        for row_y in ROW_Y:
            bounds = np.array([-np.inf, *(at for _, at, its_row, *_ in OBSTACLES if its_row == row_y), np.inf])
            flags = mode[:, first : first + len(bounds) - 1]  # a view
            at = (y >= row_y if row_y == ROW_Y[-1] else abs(y - row_y) <= ROW_REACH) & ~flags.any(1)
            flags |= at[:, None] & (x[:, None] > bounds[:-1]) & (x[:, None] < bounds[1:])
            first += flags.shape[1]
        # the original compares with 0.35 here, so exactly 0.5 and 0.65 count as the outermost passage too
        mode[:, 8] |= at & (x > 0.35) & ~mode[:, 5:8].any(1)
        self._mode[rows] = mode

    def _scene(self) -> Any:
        root = scene()
        root.attach(panda())
        for name, x, y, radius, half_height in OBSTACLES:
            body = root.worldbody.add("body", name=name, pos=(x, y, 0))
            body.add("geom", name=name, type="cylinder", size=(radius, half_height), rgba=(1, 0, 0, 1))
        line = {"type": "box", "size": (0.5, 0.01, 0.005), "pos": (0.4, FINISH_Y, 0), "rgba": (0, 1, 0, 1)}
        root.worldbody.add("geom", name="finish_line", contype=0, conaffinity=0, **line)
        return root
