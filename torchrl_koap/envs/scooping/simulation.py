# This source code is licensed under the MIT license found in the LICENSE file.
"""Simulates Scooping in batches: reads joint targets, returns the pose of the spoon and the pieces on it.

The scene has a table, a bowl, free pieces, a camera, and a Panda made of capsules, or a hand, that holds the spoon. All
are primitive shapes, which are fast in software rendering; the arm roughly has the outline of its meshes.
"""

from __future__ import annotations

import functools
import math

import mujoco
import numpy as np

from torchrl_koap.envs.mujoco.simulation import Simulations
from torchrl_koap.lookup import lookup
from torchrl_koap.tasks.panda_kinematics import FLANGE, JOINT_HIGH, JOINT_LOW, LINKS
from torchrl_koap.tasks.scooping import (
    BOWL,
    BOWL_RADIUS,
    CONTROL_HZ,
    FRAME_HZ,
    NUM_PIECES,
    PIECE_RADIUS,
    RIM_HEIGHT,
    RIM_RADIUS,
)

TIMESTEP = 1 / 180
SPOON_HALF = (0.025, 0.023)  # half the inner length and width of the spoon (m)
WALL = 0.011  # half the height of its walls (m)
HANDLE = 0.17  # length of the handle (m)
_WHITE, _DARK = "0.93 0.93 0.93 1", "0.25 0.25 0.27 1"
_SKIN, _SLEEVE, _STEEL = "0.85 0.6 0.48 1", "0.2 0.35 0.6 1", "0.2 0.55 0.85 1"


def scooping_model(embodiment: str, *, pieces: bool = True) -> mujoco.MjModel:
    """Compiles the scene of a ``"robot"``, a Panda of seven actuated joints, or a ``"hand"``, which moves freely.

    The pieces' free joints come first, then those of robot or hand; the bowl is the only mocap body.
    """
    holder, kinds = lookup({"robot": (_arm, _ARM_SERVO), "hand": (_hand, _HAND_SERVO)}, embodiment, "embodiment")
    motors = "".join(f'<position name="a{i}" joint="j{i}" kp="{kp}" kv="{kv}"/>' for i, (kp, kv) in enumerate(kinds, 1))
    xml = f"""
<mujoco model="scooping">
  <compiler angle="radian"/>
  <option timestep="{TIMESTEP}" integrator="implicitfast" cone="pyramidal" iterations="10" tolerance="1e-6"/>
  <size memory="8M"/>
  <visual>
    <global offwidth="640" offheight="640"/>
    <quality shadowsize="0" offsamples="0" numslices="12" numstacks="8"/>
    <headlight ambient="0.45 0.45 0.45" diffuse="0.5 0.5 0.5" specular="0 0 0"/>
    <map znear="0.02" zfar="20"/>
  </visual>
  <default>
    <geom contype="0" conaffinity="0"/>
    <default class="solid"><geom contype="1" conaffinity="2" friction="0.5 0.005 0.0002" solref="0.01 1"/></default>
    <default class="tool">
      <geom contype="4" conaffinity="3" friction="0.5 0.005 0.0002" solref="0.01 1"/>
    </default>
    <default class="piece">
      <geom contype="2" conaffinity="3" type="sphere" size="{PIECE_RADIUS}" mass="0.004" condim="3"
            friction="0.5 0.003 0.0005" solref="0.01 1" rgba="0.45 0.22 0.1 1"/>
    </default>
  </default>
  <worldbody>
    <light pos="0.4 0.6 2" dir="0 -0.3 -1" directional="true" diffuse="0.4 0.4 0.4"/>
    <!-- they look at (0.46, 0, 0.15) and at (0.35, 0, 0.25) -->
    <camera name="third_person" pos="1.12 -0.42 0.62" fovy="40"
      xyaxes="0.536875 0.843661 0 -0.434480 0.276487 0.857194"/>
    <camera name="front" pos="1.6 -0.9 1.1" fovy="42" xyaxes="0.584305 0.811534 0 -0.392099 0.282311 0.875534"/>
    <geom name="table" class="solid" type="plane" size="2 2 0.1" rgba="0.72 0.66 0.56 1"/>
    {_bowl()}
    {"".join(_piece(i) for i in range(NUM_PIECES)) if pieces else ""}
    {holder()}
  </worldbody>
  <actuator>{motors}</actuator>
</mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def _bowl() -> str:
    sides = 16
    rise, run = RIM_HEIGHT, RIM_RADIUS - BOWL_RADIUS
    slope, half = math.atan2(run, rise), math.hypot(rise, run) / 2
    middle, width = (RIM_RADIUS + BOWL_RADIUS) / 2 + 0.002, RIM_RADIUS * math.tan(math.pi / sides) + 0.001
    walls = "".join(
        f'<geom class="solid" type="box" size="0.002 {width:.5f} {half:.5f}" rgba="0.95 0.93 0.85 1"'
        f' pos="{middle * math.cos(turn):.5f} {middle * math.sin(turn):.5f} {rise / 2:.5f}"'
        f' quat="{_quat(turn, slope)}"/>'
        for turn in (2 * math.pi * side / sides for side in range(sides))
    )
    floor = f'<geom type="cylinder" size="{BOWL_RADIUS + 0.005} 0.0005" rgba="0.88 0.86 0.78 1"/>'
    return f'<body name="bowl" mocap="true" pos="{BOWL[0]} {BOWL[1]} 0">{floor}{walls}</body>'


def _quat(yaw: float, pitch: float) -> str:
    """Returns the quaternion of a turn about y, then about z."""
    a, b, c, d = math.cos(yaw / 2), math.sin(yaw / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    return f"{a * c:.6f} {-b * d:.6f} {a * d:.6f} {b * c:.6f}"


def _piece(index: int) -> str:
    return f'<body name="piece{index}" pos="0.9 {index * 0.03} 0.01"><freejoint/><geom class="piece"/></body>'


def _spoon() -> str:
    """Returns a scoop open to the front (x); the origin is the middle of its floor, the handle rises at its back."""
    x, y = SPOON_HALF
    solid = f'class="tool" type="box" rgba="{_STEEL}"'
    return f"""
<geom name="spoon_floor" {solid} size="{x} {y} 0.001" pos="0 0 -0.001"/>
<geom name="spoon_left" {solid} size="{x} 0.001 {WALL}" pos="0 {y} {WALL - 0.002}"/>
<geom name="spoon_right" {solid} size="{x} 0.001 {WALL}" pos="0 {-y} {WALL - 0.002}"/>
<geom name="spoon_back" {solid} size="0.001 {y} {WALL + 0.004}" pos="{-x} 0 {WALL + 0.002}"/>
<geom name="handle" type="capsule" size="0.006" fromto="{-x} 0 {2 * WALL} {-x} 0 {HANDLE}" rgba="{_STEEL}" mass="0.05"/>
<site name="spoon" size="0.002" rgba="0 0 0 0"/>"""


# capsules of the links: from, to, radius, whether dark
_CAPSULES: tuple[tuple[tuple, ...], ...] = (
    (((0, 0, -0.19), (0, 0, -0.03), 0.06, False),),
    (((0, -0.06, 0), (0, 0.06, 0), 0.06, False), ((0, 0, 0), (0, -0.13, 0), 0.06, False)),
    (((0, 0, -0.13), (0, 0, -0.03), 0.055, False), ((0.0, 0, 0), (0.08, 0, 0), 0.05, True)),
    (((0, 0, -0.04), (0, 0, 0.04), 0.055, False), ((0, 0, 0), (-0.08, 0.09, 0), 0.055, False)),
    (((0, 0, -0.26), (0, 0.03, -0.14), 0.05, False), ((0, 0.05, -0.12), (0, 0.03, 0), 0.04, False)),
    (((0, 0, -0.03), (0, 0, 0.03), 0.05, True), ((0, 0, 0), (0.088, 0, 0), 0.04, False)),
    (((0, 0, 0.0), (0, 0, 0.08), 0.045, False),),
)
# joints: stiffness (N m / rad) and damping; with the armature, servos respond in some 50 ms
_ARM_SERVO = ((1200, 80),) * 4 + ((500, 34),) * 3
_HAND_SERVO = ((900, 60),) * 3 + ((12, 0.8),) * 3


def _arm() -> str:
    xml, closing = '<geom type="capsule" size="0.07" fromto="-0.06 0 0.06 0 0 0.06" rgba="0.93 0.93 0.93 1"/>', ""
    links = zip(LINKS, _CAPSULES, JOINT_LOW, JOINT_HIGH, strict=True)
    for index, ((offset, turn), capsules, low, high) in enumerate(links, 1):
        quat = {0: "1 0 0 0", -1: "0.707107 -0.707107 0 0", 1: "0.707107 0.707107 0 0"}[turn]
        place = " ".join(str(v) for v in offset)
        armature = 0.6 if index <= 4 else 0.25
        xml += (
            f'<body name="link{index}" pos="{place}" quat="{quat}" gravcomp="1">'
            f'<joint name="j{index}" axis="0 0 1" range="{low} {high}" armature="{armature}"/>'
        )
        for start, end, radius, dark in capsules:
            span = " ".join(f"{v:.4f}" for v in (*start, *end))
            colour = _DARK if dark else _WHITE
            xml += f'<geom type="capsule" size="{radius}" fromto="{span}" rgba="{colour}" mass="0.8"/>'
        closing += "</body>"
    # half a turn about x and the flange's eighth of a turn: at the rest pose the tool's x points ahead and z up
    place = f'pos="0 0 {FLANGE + HANDLE}" quat="0 0.923880 -0.382683 0"'
    return f'{xml}<body name="tool" {place} gravcomp="1">{_spoon()}</body>{closing}'


def _hand() -> str:
    joints = "".join(
        f'<joint name="j{i}" type="slide" axis="{axis}" armature="1"/>'
        for i, axis in enumerate(("1 0 0", "0 1 0", "0 0 1"), 1)
    )
    joints += "".join(
        f'<joint name="j{i}" axis="{axis}" armature="0.01"/>' for i, axis in enumerate(("0 0 1", "0 1 0", "1 0 0"), 4)
    )
    x, top = -SPOON_HALF[0], HANDLE
    fingers = "".join(
        f'<geom type="capsule" size="0.009" rgba="{_SKIN}" mass="0.02"'
        f' fromto="{x + 0.016} {-0.02} {top - 0.065 + 0.019 * k} {x + 0.012} 0.026 {top - 0.06 + 0.019 * k}"/>'
        for k in range(4)
    )
    return f"""
<body name="tool" gravcomp="1">{joints}{_spoon()}{fingers}
<geom type="ellipsoid" size="0.022 0.03 0.045" pos="{x - 0.012} -0.012 {top - 0.03}" rgba="{_SKIN}" mass="0.2"/>
<geom type="capsule" size="0.01" fromto="{x} 0.02 {top - 0.02} {x + 0.012} 0.012 {top + 0.03}" rgba="{_SKIN}"
  mass="0.02"/>
<geom type="capsule" size="0.026" fromto="{x - 0.02} -0.02 {top} {x - 0.11} -0.05 {top + 0.1}" rgba="{_SKIN}"
  mass="0.3"/>
<geom type="capsule" size="0.042" fromto="{x - 0.11} -0.05 {top + 0.1} {x - 0.3} -0.12 {top + 0.3}" rgba="{_SLEEVE}"
  mass="0.3"/>
</body>"""


TICKS = round(CONTROL_HZ / FRAME_HZ)  # commands per frame
SUBSTEPS = round(1 / (CONTROL_HZ * TIMESTEP))  # per command
OVER_RIM = RIM_HEIGHT + 0.05  # m; inside the rim and lower than this, the spoon has reached over the rim
LEFT_BOWL = RIM_HEIGHT + 0.04  # m; higher than this, the spoon has left the bowl
HELD_TICKS = 6  # commands for which a piece must stay on the spoon outside the bowl
_LAYOUTS, _SIDES = 6, 16  # number of settled layouts of the pieces, and of rotations of each


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

    @property
    def spoon_position(self) -> np.ndarray:
        """Position of the spoon ``[n, 3]`` (m): the middle of its floor."""
        return np.stack([data.site_xpos[self._site] for data in self.data])

    @property
    def piece_positions(self) -> np.ndarray:
        """Positions of the pieces ``[n, pieces, 3]`` (m)."""
        return np.stack([_poses(data)[:, :3] for data in self.data])

    @property
    def bowl_positions(self) -> np.ndarray:
        """Centres of the bowls ``[n, 2]``: x, y (m)."""
        return np.stack([data.mocap_pos[0, :2] for data in self.data])

    @property
    def success(self) -> np.ndarray:
        """Whether the spoon has left the bowl with a piece, bool ``[n]``."""
        return self.held >= HELD_TICKS

    def pieces_on_spoon(self, row: int) -> int:
        """Counts the pieces that lie on the spoon of one simulation."""
        data = self.data[row]
        local = (_poses(data)[:, :3] - data.site_xpos[self._site]) @ data.site_xmat[self._site].reshape(3, 3)
        inside = (np.abs(local[:, :2]) < np.array(SPOON_HALF) + 0.002).all(1)
        return int((inside & (local[:, 2] > 0) & (local[:, 2] < 4 * PIECE_RADIUS)).sum())

    def reset(self, rows: np.ndarray, joints: np.ndarray, turns, bowls: np.ndarray | None = None) -> None:
        """Starts episodes with ``joints [len(rows), nu]`` (rad; the hand's first three in m).

        ``turns``, numbers in -pi to pi, select layout and rotation of the pieces. ``bowls [len(rows), 2]`` are the
        positions of the bowls (m), by default all at the same place.
        """
        bank = settled_layouts()
        places = np.tile(BOWL, (len(rows), 1)) if bowls is None else bowls
        for row, own, turn, bowl in zip(rows, joints, turns, places, strict=True):
            data = self.data[row]
            mujoco.mj_resetData(self.model, data)
            share = (turn + math.pi) / (2 * math.pi)
            layout = bank[min(int(share * _LAYOUTS), _LAYOUTS - 1)]
            angle = 2 * math.pi / _SIDES * int(share * _LAYOUTS * _SIDES % _SIDES)
            poses = _poses(data)
            poses[:, :3] = _turned(layout, angle)
            poses[:, :2] += bowl - BOWL
            data.mocap_pos[0, :2] = bowl
            data.qpos[-len(own) :] = data.ctrl[:] = self.commands[row] = own
            mujoco.mj_forward(self.model, data)
        self.rim[rows] = False
        self.held[rows] = 0

    def advance(self, rows: np.ndarray, targets: np.ndarray) -> None:
        """Advances by one frame; commands go in equal steps from the last target to the new one ``[n, nu]``."""

        def advance(piece: np.ndarray) -> None:
            for row in piece:
                data, begin = self.data[row], self.commands[row].copy()
                for tick in range(1, TICKS + 1):
                    data.ctrl[:] = begin + (targets[row] - begin) * tick / TICKS
                    mujoco.mj_step(self.model, data, SUBSTEPS)
                    self._assess(row, data)
                mujoco.mj_kinematics(self.model, data)  # updates the spoon to the present joints
                self.commands[row] = targets[row]

        self._run(advance, rows, TICKS * SUBSTEPS)

    def _assess(self, row: int, data: mujoco.MjData) -> None:
        x, y, height = data.site_xpos[self._site]
        bowl = data.mocap_pos[0]
        over = math.hypot(x - bowl[0], y - bowl[1]) < RIM_RADIUS
        self.rim[row] |= over and height < OVER_RIM
        left = self.rim[row] and height > LEFT_BOWL
        if self.held[row] < HELD_TICKS:
            self.held[row] = self.held[row] + 1 if left and self.pieces_on_spoon(row) else 0


def _poses(data: mujoco.MjData) -> np.ndarray:
    """Returns a writable view of the poses of the pieces ``[pieces, 7]``."""
    return data.qpos[: 7 * NUM_PIECES].reshape(NUM_PIECES, 7)


def _turned(layout: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    x, y = layout[:, 0] - BOWL[0], layout[:, 1] - BOWL[1]
    return np.stack([BOWL[0] + c * x - s * y, BOWL[1] + s * x + c * y, layout[:, 2]], 1)


@functools.cache
def settled_layouts() -> np.ndarray:
    """Returns pieces at rest in the bowl ``[layouts, pieces, 3]`` (m), always the same; computed once per process."""
    model = scooping_model("hand")
    data = mujoco.MjData(model)
    layouts = []
    for seed in range(_LAYOUTS):
        generator = np.random.default_rng(seed)
        mujoco.mj_resetData(model, data)
        data.qpos[-6:] = data.ctrl[:] = (0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
        poses = _poses(data)
        radius, angle = 0.05 * np.sqrt(generator.random(NUM_PIECES)), generator.uniform(0, 2 * math.pi, NUM_PIECES)
        poses[:, 0], poses[:, 1] = BOWL[0] + radius * np.cos(angle), BOWL[1] + radius * np.sin(angle)
        poses[:, 2] = 0.02 + 0.006 * np.arange(NUM_PIECES)
        mujoco.mj_step(model, data, 360)
        data.qvel[:] = 0
        layouts.append(poses[:, :3].copy())
    return np.stack(layouts)
