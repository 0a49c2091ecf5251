# This source code is licensed under the MIT license found in the LICENSE file.
"""The scene of D3IL's tasks as a `dm_control.mjcf` model: table, lights, cameras and the Franka Panda arm.

The numbers are D3IL's (docs/appendix/d3il.md, Simulator and Robot), not those of the Panda that ships with
``gymnasium-robotics``: only the ten meshes are taken from that package. Lengths in m, masses in kg, inertias in kg m^2,
angles in rad, quaternions (w, x, y, z).
"""

from __future__ import annotations

import importlib.util
import math
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import mujoco  # reads MUJOCO_GL, so it is imported before the variable is hidden

from torchrl_koap.envs.mujoco.kinematics import TIMESTEP
from torchrl_koap.graphics import no_graphics
from torchrl_koap.tasks.panda_kinematics import FLANGE, LINKS

if importlib.util.find_spec("dm_control") is None:
    raise RuntimeError(
        "the simulators of D3IL's tasks need dm-control, a separate step on Python 3.13 and later: pip install"
        " --no-deps dm-control (it asks for labmaze, which has no wheels there and is not needed)"
    )
# Importing dm_control opens an OpenGL back end (and fails if MUJOCO_GL names one that is not installed), although
# building a scene needs none. Programs that need dm_control's own renderer must import it before this package.
if "dm_control._render" in sys.modules:
    from dm_control import mjcf
else:
    with no_graphics(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from dm_control import mjcf

PANDA = "panda/"  # prefix of every name of the arm inside a scene

_WOOD = (0.8, 0.655, 0.45, 1)
_ALUMINIUM = (0.6, 0.6, 0.62, 1)
_STIFF = {"solref": (0.002, 1), "solimp": (0.999, 0.999, 0.001), "contype": 7, "conaffinity": 7}
_DRAWN = {"contype": 0, "conaffinity": 0}

TCP_OFFSET = 0.105  # tool centre point along the hand's z axis
HAND_QUAT = (0.92388, 0.0, 0.0, -0.382683)  # D3IL's rounded -45 deg about z

_TURN = 0.5**0.5
_TURNS = ((1.0, 0.0, 0.0, 0.0), (_TURN, _TURN, 0.0, 0.0), (_TURN, -_TURN, 0.0, 0.0))  # about x: none, +90, -90 deg
# mass and centre of mass of the links, in the order of the chain
_MASSES = (
    (3.01399, (-0.0291898, -0.000879465, 0.0566032)),
    (2.77281, (1.1399e-05, -0.0312655, -0.0693733)),
    (2.7996, (-1.31766e-05, -0.0703216, 0.0311782)),
    (2.14603, (0.0443483, 0.0249283, -0.03813)),
    (2.18807, (-0.0385503, 0.0395256, 0.0247162)),
    (3.19545, (-6.36776e-05, 0.0384124, -0.10997)),
    (1.35761, (0.0510023, 0.00693267, 0.00616899)),
    (0.417345, (0.0103614, 0.0103596, 0.0791078)),
)
# principal inertia of the links and its frame
_INERTIA = (
    ((0.0126801, 0.0117603, 0.00856656), (0.00411744, 0.564916, 0.0132875, 0.825031)),
    ((0.0164224, 0.0153969, 0.00546286), (0.98466, 0.174481, -0.000101815, 0.000347662)),
    ((0.016787, 0.0157415, 0.00553027), (0.57484, 0.818266, -6.05764e-05, -6.61626e-05)),
    ((0.00915257, 0.00896477, 0.00384742), (0.0615263, 0.349824, 0.234291, 0.904956)),
    ((0.00946899, 0.00928491, 0.00396694), (0.813566, 0.465041, 0.309792, 0.160858)),
    ((0.0278873, 0.0268823, 0.00569569), (0.990767, -0.135571, 0.000963106, 0.000694406)),
    ((0.00412168, 0.0033698, 0.00213304), (-0.0460841, 0.754362, 0.044494, 0.653325)),
    ((0.000637671, 0.000528056, 0.000279577), (0.63547, 0.278021, -0.670462, 0.263369)),
)
_LOW = (-2.9671, -1.8326, -2.9671, -3.1416, -2.9671, -0.0873, -2.9671)  # of the joints
_HIGH = (2.9671, 1.8326, 2.9671, 0.0873, 2.9671, 3.8223, 2.9671)
_MOTOR_LIMITS = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
_FINGER_LIMIT = 70.0
_MESHES = (*(f"link{i}" for i in range(8)), "hand", "finger")


def mesh_folder() -> Path:
    """Finds the ten detailed Panda meshes of the package ``gymnasium-robotics``; an error says if they are missing."""
    spec = importlib.util.find_spec("gymnasium_robotics")
    if spec is None or spec.origin is None:
        raise ImportError(
            "the Panda meshes come from the package 'gymnasium-robotics', which is not installed:"
            " pip install 'gymnasium-robotics>=1.4'"
        )
    folder = Path(spec.origin).parent / "envs" / "assets" / "kitchen_franka" / "franka_assets" / "meshes" / "visual"
    missing = [name for name in _MESHES if not (folder / f"{name}.stl").exists()]
    if missing:
        raise FileNotFoundError(
            f"the installed 'gymnasium-robotics' has no Panda mesh {missing[0]}.stl in {folder} (version 1.4.2 does)"
        )
    return folder


def panda(*, rod: bool = True, link_collisions: bool = False, alpha: float = 0.3) -> mjcf.RootElement:
    """Builds the arm: 7 hinge joints, 2 finger slides, 9 motors, TCP body, wrist camera, optionally a rod in the hand.

    Rod, fingers, finger pads and hand always collide. Names: joints ``joint1`` ...
    ``joint7``, ``finger_left``, ``finger_right`` (motors alike), bodies ``link0`` ... ``link8``, ``hand``, ``tcp``,
    geom ``rod``, camera ``wrist``.

    With ``link_collisions`` the convex hulls of links 0-7 collide with objects and table too. Unlike in the original,
    they do not collide with each other: joint limits and tasks prevent that, and testing takes time.
    """
    folder = mesh_folder()
    root = mjcf.RootElement(model="panda")
    root.compiler.angle = "radian"
    for name in _MESHES:
        root.asset.add("mesh", name=name, file=str(folder / f"{name}.stl"))
    colour, dark = (0.95, 0.95, 0.95, alpha), (0.25, 0.25, 0.28, alpha)
    hull = {"contype": int(link_collisions), "conaffinity": 0}  # with a conaffinity links would collide with links

    body = root.worldbody
    placed = (((0.0, 0.0, 0.0), 0), *LINKS)
    links = zip(placed, _MASSES, _INERTIA, strict=True)
    for index, ((offset, turn), (mass, com), (inertia, frame)) in enumerate(links):
        body = body.add("body", name=f"link{index}", pos=offset, quat=_TURNS[turn])
        body.add("inertial", mass=mass, pos=com, diaginertia=inertia, quat=frame)
        if index:
            joint = {"type": "hinge", "axis": (0, 0, 1), "limited": True, "range": (_LOW[index - 1], _HIGH[index - 1])}
            body.add("joint", name=f"joint{index}", **joint)
        wrist = {"solimp": (1.998, 1.999, 0.0)} if index == 7 else {}
        body.add("geom", name=f"link{index}", type="mesh", mesh=f"link{index}", rgba=colour, **hull, **wrist)

    flange = body.add("body", name="link8", pos=(0, 0, FLANGE))
    flange.add("inertial", mass=0.1, pos=(0, 0, 0), diaginertia=(0.1, 0.1, 0.1))
    hand = flange.add("body", name="hand", quat=HAND_QUAT)
    hand.add(
        "inertial",
        mass=0.670782,
        pos=(-2.76618e-6, -0.00061547, 0.0239295),
        diaginertia=(0.00227632, 0.00206087, 0.000456542),
        quat=(0.697945, 0.716151, -0.000242485, 8.47563e-5),
    )
    hand.add("geom", name="hand", type="mesh", mesh="hand", rgba=colour, solimp=(1.998, 1.999, 0.0))
    hand.add("camera", name="wrist", pos=(0.1, 0, 0), euler=(0, 3.14, 1.57), fovy=60)
    hand.add("body", name="tcp", pos=(0, 0, TCP_OFFSET))
    if rod:
        _add_rod(hand)
    for side, name in ((1.0, "left"), (-1.0, "right")):
        _add_finger(hand, side, name, dark)

    chain = [f"link{i}" for i in range(9)] + ["hand"]
    for first, second in zip(chain, chain[1:], strict=False):
        root.contact.add("exclude", body1=first, body2=second)
    motors = [(f"joint{i + 1}", limit) for i, limit in enumerate(_MOTOR_LIMITS)]
    motors += [("finger_left", _FINGER_LIMIT), ("finger_right", _FINGER_LIMIT)]
    for motor, limit in motors:
        root.actuator.add("motor", name=motor, joint=motor, gear=(1,), forcelimited=True, forcerange=(-limit, limit))
    return root


def _add_rod(hand: mjcf.Element) -> None:
    # in D3IL the inertia of rod and tip follows from their shapes at the density of water
    radius, length, density = 0.01, 0.3, 1000.0
    mass = density * math.pi * radius**2 * length
    across, along = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    rod = hand.add("body", name="rod")
    rod.add("inertial", mass=mass, pos=(0, 0, 0.075), diaginertia=(across, across, along))
    rod.add("geom", name="rod", type="cylinder", size=(0.01, 0.15), pos=(0, 0, 0.075), rgba=(0.2, 0.4, 0.8, 1))
    tip = rod.add("body", name="rod_tip")
    mass = density * 4 / 3 * math.pi * radius**3
    tip.add("inertial", mass=mass, pos=(0, 0, 0.225), diaginertia=(0.4 * mass * radius**2,) * 3)
    tip.add("geom", name="rod_tip", type="sphere", size=(0.01,), pos=(0, 0, 0.225), rgba=(0.2, 0.4, 0.8, 1), **_DRAWN)


def _add_finger(hand: mjcf.Element, side: float, name: str, colour: tuple) -> None:
    finger = hand.add("body", name=f"finger_{name}", pos=(0, 0, 0.0584))
    finger.add(
        "inertial",
        mass=0.0218754,
        pos=(-2.42335e-5 * side, 0.0119585 * side, 0.0237816),
        diaginertia=(5.69661e-6, 5.56035e-6, 1.55183e-6),
        quat=(0.996177, 0.0868631 * side, -2.77937e-5 * side, -0.00926642),
    )
    slide = {"type": "slide", "axis": (0, side, 0), "limited": True, "range": (0, 0.04), "damping": 10}
    finger.add("joint", name=f"finger_{name}", **slide)
    firm = {"condim": 4, "margin": 0.001, "solimp": (0.998, 0.999, 0.001)}
    turned = {} if side > 0 else {"quat": (0, 0, 0, 1)}
    shape = {"type": "mesh", "mesh": "finger", "friction": (1, 0.005, 0.0001), "solref": (0.02, 1), "rgba": colour}
    finger.add("geom", name=f"finger_{name}", **shape, **firm, **turned)
    tip = finger.add("body", name=f"finger_tip_{name}", pos=(0, 0.0085 * side, 0.056))
    tip.add("inertial", mass=0.01, pos=(0, 0, 0), diaginertia=(0.01, 0.01, 0.01), quat=(0, 0, 0, 1))
    pad = {"type": "box", "size": (0.008, 0.004, 0.008), "pos": (0, -0.005 * side, -0.012), "rgba": colour}
    tip.add("geom", name=f"pad_{name}", **pad, friction=(2, 0.05, 0.0001), solref=(0.01, 0.5), **firm)


def scene() -> mjcf.RootElement:
    """Builds the part that scenes share. Tasks attach the arm after their free bodies, which come first in the state.

    World: x forward, y left, z up, robot base at the origin; the table top lies at z = -0.019 m.
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
    return root


def compile_scene(root: mjcf.RootElement) -> mujoco.MjModel:
    """Compiles a scene into a MuJoCo model, which any number of simulations may share."""
    return mujoco.MjModel.from_xml_string(root.to_xml_string(), root.get_assets())


def add_free_box(root: mjcf.RootElement, name: str, half: Sequence[float], colour: Sequence[float]) -> None:
    """Adds a box of 50 g that moves freely; ``half`` are its half sizes (m)."""
    box = root.worldbody.add("body", name=name)
    box.add("freejoint", name=name)
    box.add("geom", name=name, type="box", size=half, mass=0.05, rgba=colour)
