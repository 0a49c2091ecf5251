# This source code is licensed under the MIT license found in the LICENSE file.
"""A batch of Scooping's simulations: joint targets in, the spoon's pose and the pieces in it out."""

from __future__ import annotations

import functools
import math

import mujoco
import numpy as np

from torchrl_koap.envs.mujoco.simulation import Simulations
from torchrl_koap.envs.scooping.scene import SPOON_HALF, TIMESTEP, scooping_model
from torchrl_koap.tasks.scooping import BOWL, CONTROL_HZ, FRAME_HZ, NUM_PIECES, PIECE_RADIUS, RIM_HEIGHT, RIM_RADIUS

TICKS = round(CONTROL_HZ / FRAME_HZ)  # commands per frame
SUBSTEPS = round(1 / (CONTROL_HZ * TIMESTEP))  # per command
OVER_RIM = RIM_HEIGHT + 0.05  # m; lower than that over the bowl, the spoon has reached over its rim
LEFT_BOWL = RIM_HEIGHT + 0.04  # m; higher than that, the spoon has left the bowl
HELD_TICKS = 6  # commands for which a piece has to stay on a spoon that has left the bowl
_LAYOUTS, _SIDES = 6, 16  # settled layouts of the pieces; turns by which they can be laid


class ScoopingSimulations(Simulations):
    """Simulations of one embodiment, ``"robot"`` or ``"hand"``."""

    def __init__(self, embodiment: str, num_sims: int, num_threads: int = 1):
        super().__init__(scooping_model(embodiment), num_sims, num_threads)
        self.embodiment = embodiment
        self.commands = np.zeros((num_sims, self.model.nu))
        self.rim = np.zeros(num_sims, dtype=bool)
        self.held = np.zeros(num_sims, dtype=np.int64)
        self._episode = {"commands": self.commands, "rim": self.rim, "held": self.held}
        self._site = self.model.site("spoon").id
        self._pieces = 7 * NUM_PIECES  # numbers that make up the pieces' poses

    @property
    def spoon_position(self) -> np.ndarray:
        """Position of the spoon ``[n, 3]`` (m): the middle of its floor."""
        return np.stack([data.site_xpos[self._site] for data in self.data])

    @property
    def piece_positions(self) -> np.ndarray:
        """Positions of the pieces ``[n, pieces, 3]`` (m)."""
        return np.stack([_positions(data) for data in self.data])

    @property
    def bowl_positions(self) -> np.ndarray:
        """Where the bowls' centres stand ``[n, 2]``: x, y (m)."""
        return np.stack([data.mocap_pos[0, :2] for data in self.data])

    @property
    def success(self) -> np.ndarray:
        """Whether the spoon has left the bowl with a piece, bool ``[n]``."""
        return self.held >= HELD_TICKS

    def pieces_on_spoon(self, rows=None) -> np.ndarray:
        """Counts the pieces that lie on the spoon, int64 ``[len(rows)]``, of all simulations by default."""
        return np.array([self._on_spoon(self.data[row]) for row in (range(len(self)) if rows is None else rows)])

    def _on_spoon(self, data: mujoco.MjData) -> int:
        local = (_positions(data) - data.site_xpos[self._site]) @ data.site_xmat[self._site].reshape(3, 3)
        inside = (np.abs(local[:, :2]) < np.array(SPOON_HALF) + 0.002).all(1)
        return int((inside & (local[:, 2] > 0) & (local[:, 2] < 4 * PIECE_RADIUS)).sum())

    def reset(self, rows: np.ndarray, joints: np.ndarray, turns, bowls: np.ndarray | None = None) -> None:
        """Starts episodes with ``joints [len(rows), nu]`` (rad; the hand's first three in m).

        ``turns``, a number in -pi to pi each, decide where the pieces lie. ``bowls [len(rows), 2]`` say where the bowls
        stand (m), by default all in the same place.
        """
        bank = settled_layouts()
        places = np.tile(BOWL, (len(rows), 1)) if bowls is None else bowls
        for row, own, turn, bowl in zip(rows, joints, turns, places, strict=True):
            data = self.data[row]
            mujoco.mj_resetData(self.model, data)
            share = (turn + math.pi) / (2 * math.pi)
            layout = bank[min(int(share * _LAYOUTS), _LAYOUTS - 1)]
            angle = 2 * math.pi / _SIDES * int(share * _LAYOUTS * _SIDES % _SIDES)
            poses = data.qpos[: self._pieces].reshape(NUM_PIECES, 7)
            poses[:, :3] = _turned(layout, angle)
            poses[:, :2] += bowl - BOWL
            data.mocap_pos[0, :2] = bowl
            data.qpos[self._pieces :] = own
            data.ctrl[:] = own
            mujoco.mj_forward(self.model, data)
            self.commands[row] = own
        self.rim[rows] = False
        self.held[rows] = 0

    def advance(self, rows: np.ndarray, targets: np.ndarray) -> None:
        """Advances by one frame: the commands go from the last target to the new one ``[n, nu]`` in equal parts.

        Raises:
            RuntimeError: if a simulation becomes unstable.
        """

        def advance(piece: np.ndarray) -> None:
            for row in piece:
                data, begin = self.data[row], self.commands[row].copy()
                for tick in range(1, TICKS + 1):
                    data.ctrl[:] = begin + (targets[row] - begin) * tick / TICKS
                    mujoco.mj_step(self.model, data, SUBSTEPS)
                    self._assess(row, data)
                mujoco.mj_kinematics(self.model, data)  # the spoon where the joints are now
                self.commands[row] = targets[row]

        self._run(advance, rows, TICKS * SUBSTEPS)

    def _assess(self, row: int, data: mujoco.MjData) -> None:
        x, y, height = data.site_xpos[self._site]
        bowl = data.mocap_pos[0]
        over = math.hypot(x - bowl[0], y - bowl[1]) < RIM_RADIUS
        self.rim[row] |= over and height < OVER_RIM
        left = self.rim[row] and height > LEFT_BOWL
        if self.held[row] < HELD_TICKS:
            self.held[row] = self.held[row] + 1 if left and self._on_spoon(data) else 0


def _positions(data: mujoco.MjData) -> np.ndarray:
    return data.qpos[: 7 * NUM_PIECES].reshape(NUM_PIECES, 7)[:, :3]


def _turned(layout: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    x, y = layout[:, 0] - BOWL[0], layout[:, 1] - BOWL[1]
    return np.stack([BOWL[0] + c * x - s * y, BOWL[1] + s * x + c * y, layout[:, 2]], 1)


@functools.cache
def settled_layouts() -> np.ndarray:
    """Returns pieces at rest in the bowl ``[layouts, pieces, 3]`` (m), always the same, dropped once per process."""
    model = scooping_model("hand")
    data = mujoco.MjData(model)
    layouts = []
    for seed in range(_LAYOUTS):
        generator = np.random.default_rng(seed)
        mujoco.mj_resetData(model, data)
        data.qpos[-6:] = data.ctrl[:] = (0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
        poses = data.qpos[: 7 * NUM_PIECES].reshape(NUM_PIECES, 7)
        radius, angle = 0.05 * np.sqrt(generator.random(NUM_PIECES)), generator.uniform(0, 2 * math.pi, NUM_PIECES)
        poses[:, 0], poses[:, 1] = BOWL[0] + radius * np.cos(angle), BOWL[1] + radius * np.sin(angle)
        poses[:, 2] = 0.02 + 0.006 * np.arange(NUM_PIECES)
        mujoco.mj_step(model, data, 360)
        data.qvel[:] = 0
        layouts.append(_positions(data).copy())
    return np.stack(layouts)
