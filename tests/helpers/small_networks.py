# This source code is licensed under the MIT license found in the LICENSE file.
"""Makes small reproducible networks, controllers of Avoiding or of a plain task, and a known response model."""

import torch

from torchrl_koap.modules import DiffusionPolicy, ResponseModel, StatePlanner, TemporalUnet, make_policy
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.tasks import Action, Task, get_task
from torchrl_koap.training.methods import get_method
from torchrl_koap.training.networks import build_controller


def controller_of(method, data=None, *, preset="default", task=None):
    """Returns a controller with the statistics of data ``[N]``, or without statistics."""
    task = get_task("avoiding") if task is None else task
    return build_controller(task, get_method(method), ControllerConfig(preset, 0, "all"), data)


def plain_task(states, actions):
    """Returns a task of a robot with ``states`` columns and an observed command of ``actions`` columns."""
    named = {f"a{column}": Action(column=column) for column in range(actions)}
    parts = {"command": actions, "robot": states}
    return Task(name="plain", observation_parts=parts, actions=named, position="robot", command="command")


def small_planner(columns=2, **options):
    """Returns a planner of ``columns`` state columns."""
    torch.manual_seed(0)
    unet = TemporalUnet(columns, 2 * columns, channels=(8, 16))
    return StatePlanner(unet, state_dim=columns, **({"num_steps": 2} | options))


def chunk_policy(state_of=(0, 1), actions=2):
    torch.manual_seed(0)
    columns = len(state_of)
    unet = TemporalUnet(actions, 2 * columns, channels=(8, 16))
    return make_policy(DiffusionPolicy(unet, state_dim=columns, action_dim=actions, num_steps=2), state_of=state_of)


def a_system():
    """Returns a stable response model of two axes."""
    system = ResponseModel([0, 1], [0, 1], [0, 1])
    system.weight[[0, 1], [0, 1], 0] = torch.tensor([0.7, 0.5])  # momentum
    system.weight[[0, 1], [0, 1], 2] = torch.tensor([0.1, 0.2])  # attraction by the command
    system.weight[[0, 1], [0, 1], 1] = torch.tensor([-0.2, 0.1])  # nonzero, so that the coordinates are independent
    system.weight[[0, 1], [0, 1], 3] = torch.tensor([0.2, 0.3])
    system.weight[[0, 1], [0, 1], 4] = torch.tensor([-0.1, 0.1])
    return system.double()
