# This source code is licensed under the MIT license found in the LICENSE file.
"""What a task is: layout of the observation, goal, modes, drawing; numbers and rules only, no simulator."""

from torchrl_koap.tasks.registry import TASKS, get_task
from torchrl_koap.tasks.task import CONTROL_HZ, HISTORY, HORIZON, REPLAN_INTERVAL, WINDOW, Task

__all__ = ["CONTROL_HZ", "HISTORY", "HORIZON", "REPLAN_INTERVAL", "TASKS", "WINDOW", "Task", "get_task"]
