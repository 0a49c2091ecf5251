# This source code is licensed under the MIT license found in the LICENSE file.
"""Scooping: a spoon takes pieces out of a bowl; planner and controller see only a camera."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from torchrl_koap.tasks.action_rules import Action
from torchrl_koap.tasks.registry import register_task
from torchrl_koap.tasks.scene import Body, Scene, Shape
from torchrl_koap.tasks.task import Defaults, Task

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from tensordict import TensorDictBase

BOWL = (0.52, 0.0)  # centre of the bowl (m)
BOWL_REACH = (0.05, 0.06)  # largest displacement of a moving bowl from there, x and y (m)
BOWL_RADIUS = 0.055  # of its floor (m)
RIM_RADIUS, RIM_HEIGHT = 0.11, 0.05  # m
NUM_PIECES, PIECE_RADIUS = 36, 0.009  # m
START_HEIGHT = 0.2  # of the spoon (m)
START_HALF = 0.02  # half the extent of a start region (m)
STARTS = {"left": (0.5, 0.22), "near": (0.33, 0.0), "right": (0.5, -0.22)}  # of the spoon: x, y (m)
FRAME_HZ = 10.0  # frames, and actions, per second
CONTROL_HZ = 30.0  # commands per second
EMBEDDING_DIM = 96  # columns
IMAGE_SIZE = 96  # pixels, both ways
CAMERA = "third_person"


def start_of(context: np.ndarray) -> int:
    """Returns the number of the start position that a context ``[bodies, 3]`` was drawn around (:data:`STARTS`)."""
    x, y = context[0][:2]
    distances = [(x - a) ** 2 + (y - b) ** 2 for a, b in STARTS.values()]
    return distances.index(min(distances))


def scores(result: dict[str, Any], episodes: Sequence[TensorDictBase], *_: Any) -> dict[str, Any]:
    """Returns whether the spoon came over the bowl, and whether it left with a piece, by start position.

    ``rates`` maps names to a bool per rollout (a trajectory ``[T_i]`` each); starts without episodes are left out.
    """
    last = [episode[-1]["next"] for episode in episodes]
    rates = {"spoon over the bowl": [bool(end["mode"][0]) for end in last]}
    starts = [start_of(end["context"].numpy()) for end in last]
    for number, name in enumerate(STARTS):
        own = [bool(end["success"]) for end, start in zip(last, starts, strict=True) if start == number]
        if own:
            rates[f"success from {name}"] = own
    return {"rates": rates}


_START_REGIONS = tuple(((x - START_HALF, x + START_HALF), (y - START_HALF, y + START_HALF)) for x, y in STARTS.values())
_SCOOPING = register_task(
    Task(
        name="scooping",
        observation_parts={CAMERA: EMBEDDING_DIM, "spoon": ("x", "y", "z")},
        observation_units=("",) * EMBEDDING_DIM + ("m",) * 3,
        position="spoon",
        hidden=("spoon",),
        actions={f"joint {joint}": Action("rad", "absolute") for joint in range(1, 8)},
        max_steps=120,
        control_hz=FRAME_HZ,
        score="torchrl_koap.tasks.scooping:scores",
        env="torchrl_koap.envs.scooping:ScoopingEnv",
        expert="torchrl_koap.envs.scooping.expert:ScoopingExpert",
        scene=Scene(
            shapes=(Shape("circle", BOWL, (RIM_RADIUS, RIM_RADIUS), "zone", label="bowl"),),
            bodies=(Body("spoon", "spoon", color="grey", half=(0.02, 0.02)),),
            shared_starts=_START_REGIONS,
            start_yaw=(-180.0, 180.0),
            x=(0.25, 0.7),
            y=(-0.3, 0.3),
            caption=" The spoon's path; the circle is the rim of the bowl.",
            camera=CAMERA,
        ),
        defaults=Defaults(
            demonstrations=100,
            planner={"steps": 4000},
            relative=False,
            recovery=0.0,
            neighbor_recovery=2.0,  # no column is a position that could be displaced
            # with feedback, position errors of the embedded frames act as velocities
            execution={"strategy": "open_loop", "replan_interval": 8, "blend": 0.0},
        ),
    )
)
# harder: the bowl has another place in every episode, and a few demonstrations do not cover all places
_BOWL_REGION = (
    (BOWL[0] - BOWL_REACH[0], BOWL[0] + BOWL_REACH[0]),
    (BOWL[1] - BOWL_REACH[1], BOWL[1] + BOWL_REACH[1]),
)
register_task(
    replace(
        _SCOOPING,
        name="scooping_moving_bowl",
        observation_parts={**_SCOOPING.observation_parts, "bowl": ("bowl_x", "bowl_y")},
        observation_units=_SCOOPING.observation_units + ("m",) * 2,
        hidden=("spoon", "bowl"),
        env_options={"task": "scooping_moving_bowl"},
        # the nearest other picture may show the bowl at another place
        defaults=replace(_SCOOPING.defaults, neighbor_recovery=0.0),
        scene=replace(
            _SCOOPING.scene,
            shapes=(),
            bodies=(
                replace(_SCOOPING.bodies[0], starts=_START_REGIONS),
                Body("bowl", "bowl", starts=(_BOWL_REGION,), half=(BOWL_RADIUS, BOWL_RADIUS), still=True),
            ),
            shared_starts=(),
            caption=" The spoon's path, and where the bowl stands.",
        ),
    )
)
