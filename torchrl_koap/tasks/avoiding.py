# This source code is licensed under the MIT license found in the LICENSE file.
"""Avoiding: steer a rod between six cylinders to the finish line, in any of 24 ways."""

from __future__ import annotations

import itertools

import numpy as np
from torch import Tensor

from torchrl_koap.tasks.action_rules import Action
from torchrl_koap.tasks.modes import Modes
from torchrl_koap.tasks.registry import register_task
from torchrl_koap.tasks.scene import Scene, Shape
from torchrl_koap.tasks.task import Defaults, Task

FINISH_Y = 0.35  # m
ROD_RADIUS = 0.01  # m
ROW_Y = (-0.1, 0.08, 0.26)  # y of the rows of cylinders (m)
ROW_REACH = 0.03  # m before and behind a row of cylinders: the first frame within it decides the gap
# name, x, y, radius, half height (m)
OBSTACLES = (
    ("row1", 0.5, ROW_Y[0], 0.03, 0.07),
    ("row2_left", 0.425, ROW_Y[1], 0.025, 0.1),
    ("row2_right", 0.575, ROW_Y[1], 0.025, 0.1),
    ("row3_left", 0.35, ROW_Y[2], 0.025, 0.1),
    ("row3_mid", 0.5, ROW_Y[2], 0.025, 0.1),
    ("row3_right", 0.65, ROW_Y[2], 0.025, 0.1),
)
# for every mode, whether each gap was passed; the rows have two, three and four gaps
_FLAGS = tuple(
    tuple(int(gap in gaps) for gap in range(9)) for gaps in itertools.product((0, 1), (2, 3, 4), (5, 6, 7, 8))
)


def goal_reached(task: Task, state: Tensor) -> Tensor:
    """Returns whether the tool is behind the finish line, bool ``[*B]``, for states ``[*B, d]``."""
    return state[..., 1] > FINISH_Y


def mode_of_path(path: np.ndarray) -> int:
    """Returns the mode of tool positions ``[T, 2]`` (m) by the gaps that they pass; -1 if a row is not reached."""
    mode = 0
    for y in ROW_Y:
        cylinders = [x for _, x, row, *_ in OBSTACLES if row == y]
        near = path[:, 1] >= y if y == ROW_Y[-1] else abs(path[:, 1] - y) <= ROW_REACH
        if not near.any():
            return -1
        mode = mode * (len(cylinders) + 1) + int((path[near.argmax(), 0] > cylinders).sum())
    return mode


_CYLINDERS = tuple(
    Shape("circle", (x, y), (radius + around, radius + around), role)
    for _, x, y, radius, _ in OBSTACLES
    for around, role in ((ROD_RADIUS, "clearance"), (0.0, "obstacle"))
)
register_task(
    Task(
        name="avoiding",
        observation_parts={"desired_xy": 2, "measured_xy": 2},
        command="desired_xy",
        position="measured_xy",
        actions={"x": Action("m", column=0), "y": Action("m", column=1)},
        max_steps=250,
        robot=(0, 1),
        goal="torchrl_koap.tasks.avoiding:goal_reached",
        modes=Modes(
            (
                ("row 1", ("left", "right")),
                ("row 2", ("left", "middle", "right")),
                ("row 3", ("gap 1", "gap 2", "gap 3", "gap 4")),
            ),
            leaves=_FLAGS,
            of_path="torchrl_koap.tasks.avoiding:mode_of_path",
        ),
        env="torchrl_koap.envs.avoiding:AvoidingEnv",
        expert="torchrl_koap.envs.experts.avoiding:AvoidingExpert",
        scene=Scene(
            shapes=(*_CYLINDERS, Shape("line", (0.5, FINISH_Y), (0.5, 0.0), "finish", label="finish")),
            x=(0.215, 0.785),
            y=(-0.305, 0.405),
            caption=" Solid discs are the cylinders; the pale ring is where the rod touches. Hue tells the gap taken in"
            " the last row, lightness the choices before it. Look for gaps nobody takes, and for paths that brush the"
            " rings.",
            camera="front",
        ),
        label_levels=(0.02, 0.05, 0.1, 0.25, 0.5),
        defaults=Defaults(
            demonstrations=96,
            planner={"steps": 5000, "width": 32},
            execution={"candidates": 4},  # plans between two routes collide
            relative=False,
            recovery=0.004,
        ),
    )
)
