# This source code is licensed under the MIT license found in the LICENSE file.
"""Controllers of the task Avoiding, or of one about which nothing is known but its columns."""

from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.tasks import Action, Task, get_task
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_controller


def controller_of(method, data=None, *, preset="default", task=None):
    """A controller with the statistics of data ``[N]``, or without any."""
    task = get_task("avoiding") if task is None else task
    return build_controller(task, get_method(method), ControllerConfig(preset, 0, "all"), data)


def plain_task(states, actions):
    """A robot with so many columns, whose command is the first ones and is observed."""
    named = {f"a{column}": Action(column=column) for column in range(actions)}
    parts = {"command": actions, "robot": states}
    return Task(name="plain", observation_parts=parts, actions=named, position="robot", command="command")
