# This source code is licensed under the MIT license found in the LICENSE file.
"""A robot with data and no simulator: seven joints, commanded by changes of their angles."""

from torchrl_koap import Task, register_task
from torchrl_koap.tasks import Action

JOINTS = tuple(f"joint_{index}" for index in range(1, 8))
TASK = register_task(
    Task(
        name="arm_data",
        observation_parts={"joints": JOINTS, "cup_xy": ("cup_x", "cup_y")},
        actions=dict.fromkeys(JOINTS, Action("rad")),
        position="cup_xy",
        control_hz=10.0,
        robot=tuple(range(7)),
    )
)
