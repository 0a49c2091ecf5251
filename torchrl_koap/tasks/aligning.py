# This source code is licensed under the MIT license found in the LICENSE file.
"""Aligning: push a tray, from inside or outside its walls, into a target pose."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_koap.tasks.action_rules import Action
from torchrl_koap.tasks.modes import Modes
from torchrl_koap.tasks.registry import register_task
from torchrl_koap.tasks.scene import Body, Scene, Shape
from torchrl_koap.tasks.task import Defaults, Task

DISTANCE_TOLERANCE = 0.018  # m, between the centres, height included
ROTATION_TOLERANCE = 0.048  # of half a turn
ALIGNED_DISTANCE = 0.0155  # m; horizontal part of 18 mm when tray and target centres differ by 9.1 mm in height
COMMAND_LEAD = 0.1  # m; scripted demonstrations keep the command within 0.066 of the robot
BASE_HALF = 0.05  # half width of the tray (m)
_HALF = (BASE_HALF, BASE_HALF)
REGIONS = (((0.4, 0.6), (-0.25, -0.1)), ((0.4, 0.6), (0.2, 0.35)))  # of the centres of tray and target: x, y (m)
_BOX, _TARGET = ("box_position", "box_quaternion"), ("target_position", "target_quaternion")
_POSES = dict(zip((*_BOX, *_TARGET), (3, 4, 3, 4), strict=True))  # their columns


def goal_reached(task: Task, state: Tensor) -> Tensor:
    """Returns whether the tray is at its target with the same yaw, bool ``[*B]``, for states ``[*B, d]``."""
    part = {name: state[..., columns] for name, columns in task.state_slices.items()}
    distance = (part["box_position"] - part["target_position"]).norm(dim=-1)
    cosine = torch.nn.functional.cosine_similarity(part["box_quaternion"], part["target_quaternion"], dim=-1)
    return (distance <= ALIGNED_DISTANCE) & (cosine >= math.cos(ROTATION_TOLERANCE * math.pi))


register_task(
    Task(
        name="aligning",
        observation_parts={"desired_xyz": 3, "measured_xyz": 3, **_POSES},
        command="desired_xyz",
        position="measured_xyz",
        actions={axis: Action("m", column=column) for column, axis in enumerate("xyz")},
        max_steps=400,
        robot=(0, 1, 2),
        state={"measured_xyz": "plain"}
        | {part: "plane" if size == 3 else "quaternion" for part, size in _POSES.items()},
        planar_parts=("measured_xyz", *_POSES),
        relative_positions=(
            ("measured_xyz", *_BOX),
            ("target_position", *_BOX, "target_quaternion"),
            ("measured_xyz", *_TARGET),
        ),
        goal="torchrl_koap.tasks.aligning:goal_reached",
        modes=Modes((("pushed from", ("inside", "outside")),), leaves=((0,), (1,)), entropy="contexts"),
        env="torchrl_koap.envs.aligning:AligningEnv",
        expert="torchrl_koap.envs.experts.aligning:AligningExpert",
        scene=Scene(
            shapes=tuple(Shape.over(region, "region") for region in REGIONS),
            bodies=(
                Body("box", *_BOX, REGIONS[:1], "tray", "#9a5b13", _HALF, front=True),
                Body("target", *_TARGET, REGIONS[1:], color="#0a7f7f", half=_HALF, front=True, still=True),
            ),
            x=(0.21, 0.79),
            y=(-0.39, 0.47),
            caption=" The second panel shows the tray: where it starts (an outline with a thick far side; of many only"
            " the centre and a line to the far side), its path, a dot where it ends and a cross if the rollout failed;"
            " targets are drawn likewise. The dashed frames are the ranges of both centres. Look for crosses far from"
            " any target: the tray was lost; crosses near one: the angle was wrong or time ran out.",
            camera="cage",
        ),
        label_levels=(0.02, 0.05, 0.1, 0.25, 0.5),
        defaults=Defaults(
            demonstrations=1000,
            disturbance=0.5,
            planner={"steps": 16000, "network": "mlp", "frames": 1},
            execution={"lead": COMMAND_LEAD},
            recovery=0.004,
        ),
    )
)
