# This source code is licensed under the MIT license found in the LICENSE file.
"""Tasks: columns, goal, modes, appearance, and the names of the simulation code, which is not imported here."""

from torchrl_koap.tasks.action_rules import Action
from torchrl_koap.tasks.columns import Columns
from torchrl_koap.tasks.modes import Modes
from torchrl_koap.tasks.registry import TASKS, get_task, register_task
from torchrl_koap.tasks.scene import Body, Scene, Shape
from torchrl_koap.tasks.task import CONTROL_HZ, HISTORY, HORIZON, REPLAN_INTERVAL, WINDOW, Defaults, Task

from torchrl_koap.tasks import avoiding, aligning, sorting, stacking, scooping  # isort: skip  # in the order of TASKS

__all__ = [
    "CONTROL_HZ",
    "HISTORY",
    "HORIZON",
    "REPLAN_INTERVAL",
    "TASKS",
    "WINDOW",
    "Action",
    "Body",
    "Columns",
    "Defaults",
    "Modes",
    "Scene",
    "Shape",
    "Task",
    "aligning",
    "avoiding",
    "get_task",
    "register_task",
    "scooping",
    "sorting",
    "stacking",
]
