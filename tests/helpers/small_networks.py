# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks of a few weights, always the same; controllers of the task Avoiding or of a plain one; a known robot."""

import torch

from torchrl_koap.modules import DiffusionPolicy, ResponseModel, StatePlanner, TemporalUnet, make_policy
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


def small_planner(columns=2, **options):
    """A planner of so many state columns."""
    torch.manual_seed(0)
    unet = TemporalUnet(columns, 2 * columns, channels=(8, 16))
    return StatePlanner(unet, state_dim=columns, **({"num_steps": 2} | options))


def chunk_policy(state_of=(0, 1), actions=2):
    torch.manual_seed(0)
    columns = len(state_of)
    unet = TemporalUnet(actions, 2 * columns, channels=(8, 16))
    return make_policy(DiffusionPolicy(unet, state_dim=columns, action_dim=actions, num_steps=2), state_of=state_of)


def a_system():
    """A stable response of two axes."""
    system = ResponseModel([0, 1], [0, 1], [0, 1])
    system.weight[[0, 1], [0, 1], 0] = torch.tensor([0.7, 0.5])  # momentum
    system.weight[[0, 1], [0, 1], 2] = torch.tensor([0.1, 0.2])  # pull of the command
    system.weight[[0, 1], [0, 1], 1] = torch.tensor([-0.2, 0.1])  # else its coordinates depend on each other
    system.weight[[0, 1], [0, 1], 3] = torch.tensor([0.2, 0.3])
    system.weight[[0, 1], [0, 1], 4] = torch.tensor([-0.1, 0.1])
    return system.double()
