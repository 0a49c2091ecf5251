# This source code is licensed under the MIT license found in the LICENSE file.
"""Stacking: pile three boxes on a target zone with the gripper, in any order; Stacking-1 ends with the first box."""

from __future__ import annotations

import itertools
from dataclasses import replace

import torch
from torch import Tensor

from torchrl_koap.tasks.action_rules import Action
from torchrl_koap.tasks.modes import Modes
from torchrl_koap.tasks.registry import register_task
from torchrl_koap.tasks.scene import Body, Scene, Shape
from torchrl_koap.tasks.task import Defaults, Task

TARGET = (0.5, 0.2)  # centre of the target zone (m)
TARGET_HALF = 0.05  # half its width (m)
ZONE_RADIUS = 0.06  # m; a box nearer to the centre than this (horizontally) is in the zone
HEIGHT_GAP = 0.03  # m; boxes lie on top of each other if all their heights differ by more
# name, half sizes (m)
BOXES = (("red", (0.03, 0.03, 0.03)), ("green", (0.03, 0.03, 0.03)), ("blue", (0.03, 0.05, 0.03)))
NAMES = tuple(name for name, _ in BOXES)
ORDERS = tuple(itertools.permutations(range(3)))  # modes: orders of arrival of the boxes
# where each box starts: x range, y range (m)
_STARTS = (((0.35, 0.45), (-0.25, -0.15)), ((0.35, 0.45), (-0.1, 0.0)), ((0.55, 0.6), (-0.2, 0.0)))
_JOINTS = {f"joint {joint}": Action("rad") for joint in range(1, 8)}


def _boxes_of(task: Task, state: Tensor) -> Tensor:
    """Returns the positions of the boxes ``[*B, 3, 3]``."""
    return torch.stack([state[..., task.state_slices[f"{box}_position"]] for box in task.objects], -2)


def _in_zone(boxes: Tensor) -> Tensor:
    return (boxes[..., :2] - boxes.new_tensor(TARGET)).norm(dim=-1) <= ZONE_RADIUS


def piled(boxes: Tensor) -> Tensor:
    """Returns whether boxes at ``[*B, 3, 3]`` (m) are all in the zone, far enough apart in height, bool ``[*B]``."""
    height = boxes[..., 2].sort(-1).values
    return _in_zone(boxes).all(-1) & (height.diff(dim=-1).amin(-1) > HEIGHT_GAP)


def goal_reached(task: Task, state: Tensor) -> Tensor:
    """Returns whether all boxes are piled in the zone, bool ``[*B]``, for states ``[*B, d]``."""
    return piled(_boxes_of(task, state))


def first_box_reached(task: Task, state: Tensor) -> Tensor:
    """Returns whether any box is in the zone, bool ``[*B]``, for states ``[*B, d]``."""
    return _in_zone(_boxes_of(task, state)).any(-1)


_STACKING = register_task(
    Task(
        name="stacking",
        observation_parts={"desired_joints_and_gripper": 8}
        | {part: size for box in NAMES for part, size in ((f"{box}_position", 3), (f"{box}_tan_yaw", 1))}
        | {"measured_joints": 7, "gripper_width": 1, "tcp_position": 3},
        command="desired_joints_and_gripper",
        position="tcp_position",
        actions=_JOINTS | {"gripper": Action("m", "gripper", column=7)},
        max_steps=1000,
        control_hz=1 / 0.03,
        robot=tuple(range(8)),
        tool_kinematics="torchrl_koap.tasks.panda_kinematics:tool_position",
        state={"measured_joints": "plain", "gripper_width": "plain", "tcp_position": "plain"}
        | {part: kind for box in NAMES for part, kind in ((f"{box}_position", "plain"), (f"{box}_tan_yaw", "tan_yaw"))},
        interchangeable=(("red", "green"),),
        relative_positions=(
            *(("tcp_position", f"{box}_position") for box in NAMES),
            *((f"{box}_position", f"{other}_position") for box, other in itertools.combinations(NAMES, 2)),
        ),
        goal="torchrl_koap.tasks.stacking:goal_reached",
        modes=Modes(
            (("order of arrival", tuple(", ".join(NAMES[box] for box in order) for order in ORDERS)),),
            leaves=ORDERS,
            entropy="solved_contexts",
        ),
        score="torchrl_koap.evaluation.scores:stacking_scores",
        env="torchrl_koap.envs.stacking:StackingEnv",
        env_options={"num_boxes": 3},
        expert="torchrl_koap.envs.experts.stacking:StackingExpert",
        scene=Scene(
            shapes=(
                Shape("circle", TARGET, (ZONE_RADIUS, ZONE_RADIUS), "zone", label="zone"),
                Shape("rectangle", TARGET, (TARGET_HALF, TARGET_HALF), "target"),
            ),
            bodies=tuple(
                Body(name, f"{name}_position", f"{name}_tan_yaw", (start,), f"{name} box", name, half[:2])
                for (name, half), start in zip(BOXES, _STARTS, strict=True)
            ),
            x=(0.28, 0.68),
            y=(-0.3, 0.32),
            caption=" The second panel shows the boxes: pale outlines where they start, paths in their colours, a dot"
            " where they end, a cross in rollouts that failed. The circle is how near to the zone's centre a box must"
            " come. A dot at its rim is a box that was still in the gripper when the rollout ended. Look for boxes that"
            " never moved and for those dropped on the way.",
            camera="front",
        ),
        defaults=Defaults(
            demonstrations=1000,
            planner={"steps": 16000, "network": "objects", "frames": 1},
            recovery=0.004,
            joint_recovery=0.03,  # else the plan turns on as the arm has begun to, whichever way that is
            commands=True,  # joints follow their commands in the same way in all poses
            execution={"replan_interval": 8},  # plans begin slowly: after 4 steps the arm often lifts no box
        ),
    )
)
_STACKING_1 = register_task(
    replace(
        _STACKING,
        name="stacking_1",
        max_steps=400,
        goal="torchrl_koap.tasks.stacking:first_box_reached",
        modes=Modes((("first box", NAMES),), ((0,), (1,), (2,)), "solved_contexts"),
        score=None,  # an episode ends with the first box
        env_options={"num_boxes": 1},
        data_from="stacking",
    )
)
# as in the paper: joints are commanded but not observed
register_task(
    replace(
        _STACKING_1,
        name="stacking_unobserved_joints",
        state={"tcp_position": "plain"}
        | {part: kind for part, kind in _STACKING.state.items() if part != "measured_joints"},
        hidden=("measured_joints",),
        robot=tuple(range(4)),  # position of the tool, width of the gripper
        tool_kinematics=None,
        actions=_JOINTS | {"gripper": Action("m", "gripper", column=3)},
        # the commanded joints are not observed, so commands are inferred from the scene
        defaults=replace(
            _STACKING.defaults, joint_recovery=0.0, controller={"preset": "scene", "columns": "related", "steps": 3000}
        ),
    )
)
