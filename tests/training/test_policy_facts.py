# This source code is licensed under the MIT license found in the LICENSE file.
"""What labels are learned as: changes of a command, or the command itself where it is known."""

from dataclasses import replace

import pytest
import torch

from torchrl_koap import ControllerConfig
from torchrl_koap.data import LabelBudget, flatten_trajectories, select_state
from torchrl_koap.tasks import get_task
from torchrl_koap.training.policy_facts import controller_data, decoded_commands

TASK = get_task("avoiding")  # observes the commanded and the measured position
SECTION = ControllerConfig(preset="absolute", columns="robot")


def recordings():
    torch.manual_seed(0)
    command = torch.rand(4, 31, 2).cumsum(1)
    measured = command + 0.1 * torch.rand(4, 31, 2)
    data = flatten_trajectories(list(torch.cat([command, measured], -1)), list(command.diff(dim=1)))
    return select_state(data, TASK.state_of)


@pytest.mark.parametrize("unit", ["trajectory", "window"])
def test_a_label_is_learned_as_what_the_state_lacks_of_the_command(unit):
    data, budget = recordings(), LabelBudget(count=2, unit=unit)
    labelled, _ = budget.apply(data, command=TASK.command_columns, tell_commands=True)
    view, kept = controller_data(TASK, SECTION, labelled), labelled["has_action"].squeeze(-1)
    reached = data["next", "observation"][:, :2] - data["observation"][:, 2:]
    torch.testing.assert_close(view["action"][kept], reached[kept])
    assert torch.equal(view["has_action"], labelled["has_action"]) and view["action"][~kept].isnan().all()
    torch.testing.assert_close(controller_data(TASK, SECTION, data)["action"], reached)  # all labels, nothing told
    changes = controller_data(TASK, replace(SECTION, preset="default"), labelled)
    assert torch.equal(changes["action"][kept], data["action"][kept])


def test_a_labelled_step_whose_command_is_not_known_is_none():
    labelled, _ = LabelBudget(count=2, unit="window").apply(recordings(), command=TASK.command_columns)
    assert labelled["has_action"].any() and not controller_data(TASK, SECTION, labelled)["has_action"].any()


def test_only_changes_of_commands_are_learned_otherwise():
    assert decoded_commands(TASK, "absolute") == {"states": [0, 1], "commands": [0, 1], "actions": [0, 1]}
    assert decoded_commands(get_task("stacking"), "absolute")["states"] == list(range(7))
    assert decoded_commands(TASK, "default") is None
    assert decoded_commands(get_task("scooping"), "absolute") is None  # its actions are commands
