# This source code is licensed under the MIT license found in the LICENSE file.
"""Fitting the commands of a state: on labelled steps alone, and on what belongs to them."""

import pytest
import torch
from small_controllers import controller_of
from tensordict import TensorDict

from torchrl_koap.data import LabelBudget, flatten_trajectories
from torchrl_koap.keys import LABEL_COMMAND
from torchrl_koap.modules import CommandDecoder
from torchrl_koap.tasks import get_task
from torchrl_koap.training.command_model import build_decoder, fit_decoder, gripper_columns


def recordings(episodes: int = 6, length: int = 60) -> TensorDict:
    """Two commands that are functions of one seen number: observation is commands and that number."""
    torch.manual_seed(0)
    observed, actions = [], []
    for _ in range(episodes):
        x = torch.rand(1) + torch.linspace(0, 1, length + 1)
        command = torch.stack([x, (3 * x).sin()], -1)
        observed.append(torch.cat([command, x.unsqueeze(-1)], -1))
        actions.append(command.diff(dim=0))
    data = flatten_trajectories(observed, actions)
    return data.set("state", data["observation"][:, 2:])


def small_decoder() -> CommandDecoder:
    torch.manual_seed(0)
    return CommandDecoder(1, [0, 1], [0, 1], width=32)


def test_commands_are_found_from_windows():
    data = recordings()
    budget = LabelBudget(fraction=0.1, unit="window")
    labelled, report = budget.apply(data, command=slice(0, 2), tell_commands=True)
    assert labelled["observation"][:, :2].isnan().all()
    module = small_decoder()
    found = fit_decoder(module, labelled, updates=600)
    assert found["labels_used"] == report.commands_told == int(labelled["has_action"].sum())
    x = torch.linspace(0.5, 1.3, 9).unsqueeze(-1)
    torch.testing.assert_close(module(x), torch.cat([x, (3 * x).sin()], -1), atol=0.08, rtol=0)


def test_trajectories_that_are_labelled_throughout_need_nothing_added():
    labelled, report = LabelBudget(count=2).apply(recordings(), command=slice(0, 2), tell_commands=True)
    found = fit_decoder(small_decoder(), labelled, updates=20)
    assert found["labels_used"] == int(labelled["has_action"].sum()) and report.commands_told == 0


def test_steps_without_label_are_not_read():
    data = recordings()
    budget = LabelBudget(fraction=0.1, unit="window")
    weights = []
    for other in (data, data.clone()):
        free = ~budget.apply(data)[0]["has_action"].reshape(-1)
        if weights:
            other["observation"][free] = 1e6
            other["action"][free] = 1e6
        labelled = budget.apply(other, command=slice(0, 2), tell_commands=True)[0]
        assert labelled[LABEL_COMMAND][free].isnan().all() and labelled[LABEL_COMMAND][~free].isfinite().all()
        module = small_decoder()
        torch.manual_seed(1)
        fit_decoder(module, labelled, updates=20)
        weights.append(torch.cat([value.flatten() for value in module.state_dict().values()]))
    assert torch.equal(*weights)


def test_commands_that_nobody_hid_count_at_labelled_steps_alone():
    data = recordings()
    data["has_action"] = (data["step_count"] < 7).reshape(-1, 1)
    assert fit_decoder(small_decoder(), data, updates=2)["labels_used"] == 6 * 7


def test_without_a_known_command_it_says_so():
    labelled = LabelBudget(fraction=0.1, unit="window").apply(recordings(), command=slice(0, 2))[0]
    with pytest.raises(ValueError, match="labelled steps whose command is known"):
        fit_decoder(small_decoder(), labelled)


def test_columns_of_tasks():
    task = get_task("stacking_unobserved_joints")
    decoder = build_decoder(task)
    assert decoder.commands == decoder.actions == list(range(7))
    assert gripper_columns(task) == [7, 3] and decoder(torch.zeros(3, 19)).shape == (3, 7)
    assert gripper_columns(get_task("avoiding")) is None
    assert gripper_columns(get_task("stacking")) == [7, 7]


def test_tasks_whose_actions_are_commands_are_refused():
    with pytest.raises(ValueError, match="scooping"):
        controller_of("command_regression", task=get_task("scooping"))
