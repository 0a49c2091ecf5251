# This source code is licensed under the MIT license found in the LICENSE file.
"""What all tasks share: simulator settings, table, ground, lights, cameras (docs/appendix/d3il.md, Simulator)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco

from torchrl_koap.envs.mujoco.panda import mjcf, panda

TIMESTEP = 0.001
TABLE_TOP = -0.019
PANDA = "panda/"  # prefix of every name of the arm inside a scene

_WOOD = (0.8, 0.655, 0.45, 1)
_ALUMINIUM = (0.6, 0.6, 0.62, 1)
_STIFF = {"solref": (0.002, 1), "solimp": (0.999, 0.999, 0.001), "contype": 7, "conaffinity": 7}
_DRAWN = {"contype": 0, "conaffinity": 0}


def scene(
    *,
    rod: bool = True,
    arm_alpha: float = 0.3,
    link_collisions: bool = False,
    add_objects: Callable[[mjcf.RootElement], None] | None = None,
):
    """Builds the common scene with the arm attached at the origin; tasks add what stands still to the result.

    World: x forward, y left, z up, robot base at the origin; the table top lies at z = -0.019 m. ``add_objects`` adds
    the free bodies of the task, before the arm is attached, so that they come first in the state vector. The rest is
    the arm's, see :func:`~torchrl_koap.envs.mujoco.panda.panda`.
    """
    root = mjcf.RootElement(model="d3il")
    root.compiler.angle = "radian"
    root.option.set_attributes(
        timestep=TIMESTEP,
        integrator="Euler",
        solver="Newton",
        cone="elliptic",
        impratio=3,
        tolerance=1e-10,
        iterations=100,
        ls_iterations=50,
        ls_tolerance=0.01,
        gravity=(0, 0, -9.81),
    )
    visual = root.visual
    getattr(visual, "global").set_attributes(offwidth=1024, offheight=1024)
    visual.headlight.set_attributes(ambient=(0.35, 0.35, 0.35), diffuse=(0.4, 0.4, 0.4), specular=(0.1, 0.1, 0.1))
    visual.map.set_attributes(znear=0.02, zfar=30)
    root.asset.add("texture", name="sky", type="skybox", builtin="gradient", rgb1=(0.9,) * 3, rgb2=(0.6,) * 3, width=32)

    world = root.worldbody
    world.add("light", name="lamp", pos=(0.4, 0, 2.5), dir=(0, 0, -1), diffuse=(0.5,) * 3, directional=True)
    world.add("camera", name="cage", pos=(1.05, 0, 1.2), quat=(0.6830127, 0.1830127, 0.1830127, 0.683012), fovy=45)
    world.add("camera", name="front", pos=(1.75, 0, 0.85), xyaxes=(0, 1, 0, -0.53, 0, 0.85), fovy=40)
    world.add("geom", name="ground", type="plane", pos=(0, 0, -0.94), size=(5, 5, 1), rgba=(0.75,) * 3 + (1,), **_DRAWN)
    table = world.add("body", name="table")
    table.add("geom", name="table_top", type="box", pos=(0.4, 0, -0.02), size=(0.49, 0.98, 0.001), rgba=_WOOD, **_STIFF)
    under = {"type": "box", "pos": (0.4, 0, -0.42), "size": (0.49, 0.98, 0.4), "rgba": (0, 0, 0, 0)}
    table.add("geom", name="table_under", **under, **_STIFF)
    for x in (-0.07, 0.87):
        for y in (-0.96, 0.96):
            bar = {"type": "box", "pos": (x, y, -0.48), "size": (0.02, 0.02, 0.459), "rgba": _ALUMINIUM}
            table.add("geom", **bar, **_DRAWN)
    if add_objects is not None:
        add_objects(root)
    root.attach(panda(rod=rod, alpha=arm_alpha, link_collisions=link_collisions))
    return root


def compile_scene(root: mjcf.RootElement) -> mujoco.MjModel:
    """Compiles a scene into a MuJoCo model, which any number of simulations may share."""
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def add_free_box(root: mjcf.RootElement, name: str, half: Sequence[float], colour: Sequence[float]) -> None:
    """Adds a box of 50 g that moves freely; ``half`` its sizes (m)."""
    box = root.worldbody.add("body", name=name)
    box.add("freejoint", name=name)
    box.add("geom", name=name, type="box", size=half, mass=0.05, rgba=colour)
