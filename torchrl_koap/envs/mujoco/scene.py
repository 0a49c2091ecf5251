# This source code is licensed under the MIT license found in the LICENSE file.
"""What all tasks share around the arm: simulator settings, table, ground, lights, cameras (docs/d3il.md, Simulator)."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco

from torchrl_koap.envs.mujoco.kinematics import TIMESTEP
from torchrl_koap.envs.mujoco.panda import numbers, panda


def scene(
    objects: str = "", still: str = "", *, rod: bool = True, arm_alpha: float = 0.3, link_collisions: bool = False
) -> mujoco.MjModel:
    """Compiles the common scene with the arm at the origin, which any number of simulations may share.

    World: x forward, y left, z up, robot base at the origin; the table top lies at z = -0.019 m.

    Args:
        objects (str): bodies of the task that move, in MJCF. They come before the arm, in the state vector too.
        still (str): bodies and geoms of the task that stand still; class ``drawn`` touches nothing.
        rod (bool): the hand holds a rod.
        arm_alpha (float): opacity of the arm when drawn.
        link_collisions (bool): links 0-7 collide too, see :func:`~torchrl_koap.envs.mujoco.panda.panda`.

    Examples:
        >>> from torchrl_koap.envs.mujoco.scene import scene
        >>> model = scene()
        >>> model.nq, model.nu, model.opt.timestep
        (9, 9, 0.001)
    """
    bar = '<geom class="drawn" type="box" pos="{} {} -0.48" size="0.02 0.02 0.459" rgba="0.6 0.6 0.62 1"/>'
    return mujoco.MjModel.from_xml_string(f"""
<mujoco model="d3il">
  <option timestep="{TIMESTEP}" integrator="Euler" solver="Newton" cone="elliptic" impratio="3" tolerance="1e-10"
    iterations="100" ls_iterations="50" ls_tolerance="0.01" gravity="0 0 -9.81"/>
  <visual>
    <global offwidth="1024" offheight="1024"/>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.4 0.4 0.4" specular="0.1 0.1 0.1"/>
    <map znear="0.02" zfar="30"/>
  </visual>
  <default>
    <default class="drawn"><geom contype="0" conaffinity="0"/></default>
    <default class="stiff">
      <geom type="box" contype="7" conaffinity="7" solref="0.002 1" solimp="0.999 0.999 0.001"/>
    </default>
  </default>
  <asset>
    <texture name="sky" type="skybox" builtin="gradient" rgb1="0.9 0.9 0.9" rgb2="0.6 0.6 0.6" width="32"/>
  </asset>
  <worldbody>
    <light name="lamp" pos="0.4 0 2.5" dir="0 0 -1" diffuse="0.5 0.5 0.5" directional="true"/>
    <camera name="cage" pos="1.05 0 1.2" quat="0.6830127 0.1830127 0.1830127 0.683012" fovy="45"/>
    <camera name="front" pos="1.75 0 0.85" xyaxes="0 1 0 -0.53 0 0.85" fovy="40"/>
    <geom name="ground" class="drawn" type="plane" pos="0 0 -0.94" size="5 5 1" rgba="0.75 0.75 0.75 1"/>
    <body name="table">
      <geom name="table_top" class="stiff" pos="0.4 0 -0.02" size="0.49 0.98 0.001" rgba="0.8 0.655 0.45 1"/>
      <geom name="table_under" class="stiff" pos="0.4 0 -0.42" size="0.49 0.98 0.4" rgba="0 0 0 0"/>
      {"".join(bar.format(x, y) for x in (-0.07, 0.87) for y in (-0.96, 0.96))}
    </body>
    {objects}
  </worldbody>
  {panda(rod=rod, alpha=arm_alpha, link_collisions=link_collisions)}
  <worldbody>{still}</worldbody>
</mujoco>""")


def free_box(name: str, half: Sequence[float], colour: str) -> str:
    """Writes a box of 50 g that moves freely.

    Args:
        name (str): its name.
        half (sequence of float): half its sizes (m).
        colour (str): red, green and blue, such as ``"1 0 0"``.
    """
    geom = f'<geom name="{name}" type="box" size="{numbers(half)}" mass="0.05" rgba="{colour} 1"/>'
    return f'<body name="{name}"><freejoint name="{name}"/>{geom}</body>'
