# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests what labels are learned as: changes of a command, or the command itself if the task requires it."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from torchrl_koap import ControllerConfig, fit
from torchrl_koap.data import LabelBudget, flatten_trajectories, make_demonstrations, select_state
from torchrl_koap.tasks import Action, get_task
from torchrl_koap.training import controller
from torchrl_koap.training.methods import METHODS
from torchrl_koap.training.policy_facts import (
    command_ranges,
    constant_actions,
    decoded_commands,
    policy_facts,
    state_reader,
    tells_commands,
    with_commands,
)

CHANGES = get_task("avoiding")  # observes the commanded and the measured position
TASK = replace(CHANGES, defaults=replace(CHANGES.defaults, commands=True))


def recordings():
    torch.manual_seed(0)
    command = torch.rand(4, 31, 2).cumsum(1)
    measured = command + 0.1 * torch.rand(4, 31, 2)
    data = flatten_trajectories(list(torch.cat([command, measured], -1)), list(command.diff(dim=1)))
    return select_state(data, TASK.state_of)


@pytest.mark.parametrize("unit", ["trajectory", "window"])
def test_a_label_is_learned_as_the_command_that_it_leads_to(unit):
    data, budget = recordings(), LabelBudget(count=2, unit=unit)
    labelled, _ = budget.apply(data, command=TASK.command_columns, tell_commands=True)
    learned, kept = with_commands(TASK, labelled), labelled["has_action"].squeeze(-1)
    torch.testing.assert_close(learned["action"][kept], data["next", "observation"][kept][:, :2])
    assert torch.equal(learned["has_action"], labelled["has_action"]) and learned["action"][~kept].isnan().all()
    everything = with_commands(TASK, data)["action"]  # nobody told, as nothing is hidden
    torch.testing.assert_close(everything, data["next", "observation"][:, :2])
    assert with_commands(CHANGES, labelled) is labelled


def test_a_controller_is_fitted_and_judged_by_how_far_commands_are_from_the_robot(monkeypatch):
    data, fitted = recordings(), []
    own = controller.fit_closed_form
    monkeypatch.setattr(
        controller, "fit_closed_form", lambda *given, **known: fitted.append(given) or own(*given, **known)
    )
    seen = fit(data, TASK, planner=False, controller={"steps": 0}, progress=False).seen(data)
    for action in (seen["action"], fitted[0][1]["action"]):
        torch.testing.assert_close(action, data["next", "observation"][:, :2] - data["state"])


def test_a_labelled_step_whose_command_is_not_known_is_none():
    labelled, _ = LabelBudget(count=2, unit="window").apply(recordings(), command=TASK.command_columns)
    assert labelled["has_action"].any() and not with_commands(TASK, labelled)["has_action"].any()


def test_which_commands_are_decoded_and_which_methods_get_them():
    assert decoded_commands(TASK) == {"commands": [0, 1], "actions": [0, 1]} and decoded_commands(CHANGES) is None
    assert TASK.distances == ((0, 0), (1, 1)) and CHANGES.distances == ()
    assert decoded_commands(get_task("stacking"))["actions"] == list(range(7))
    assert len(get_task("stacking").distances) == 7 and get_task("stacking_unobserved_joints").distances == ()
    assert tells_commands(TASK, METHODS["koap"]) and not tells_commands(TASK, METHODS["mpc"])  # it reads changes
    assert not tells_commands(CHANGES, METHODS["koap"])
    with pytest.raises(ValueError, match=r"defaults.commands: no action is the change of a command that"):
        replace(TASK, command=None)


def test_relative_positions_are_read_beside_the_columns_where_asked():
    task = get_task("stacking_unobserved_joints")
    widths = {name: state_reader(task, ControllerConfig(columns=name)).width for name in ("robot", "all", "related")}
    assert widths["robot"] == 4 and widths["all"] == task.state_dim < widths["related"]
    reader, states = state_reader(task, ControllerConfig(columns="related")), torch.rand(2, 3, task.state_dim)
    read = reader(states)
    assert read.shape == (2, 3, reader.width) and torch.equal(read[..., : task.state_dim], states)
    torch.testing.assert_close(read[..., task.state_dim :][..., :3], states[..., :3] - states[..., 4:7])


def test_ranges_of_commands_by_hand():
    kinds = [Action("m"), Action("m"), Action("rad", "absolute", 0), Action("", "raw"), Action("", "gripper")]
    actions = dict(zip("xyqrg", kinds, strict=True))
    task = SimpleNamespace(actions=actions, action_units=tuple(kind.unit for kind in kinds))
    labels = torch.tensor([[-0.4, 0.1, 2.0, 7.0, 1.0], [0.3, -0.2, 3.0, 7.0, 1.0], [torch.nan] * 5])
    data = {"action": labels, "has_action": torch.tensor([[True], [True], [False]]), "state": torch.tensor([[1.5]] * 3)}
    largest = [pytest.approx(-0.4), pytest.approx(0.4)]  # of both axes, in both directions
    assert command_ranges(task, data) == [largest, largest, [1.5, 3.0], [7.0, 7.0], None]
    data["has_action"][1] = False
    assert command_ranges(task, data)[3:] == [None, None]


def test_a_lead_is_for_changes_of_commands_and_not_for_targets():
    targets = {name: Action("m", "absolute", column) for column, name in enumerate(CHANGES.actions)}
    assert policy_facts(CHANGES)["commanded"] == {"states": [0, 1], "commands": [0, 1], "actions": [0, 1]}
    assert policy_facts(replace(CHANGES, actions=targets))["commanded"] is None


@pytest.mark.parametrize("kind", ["delta", "raw", "absolute"])
def test_an_action_that_labels_of_the_budget_repeat_is_commanded_as_it_is(kind):
    torch.manual_seed(0)
    states, actions = torch.rand(3, 30, 3).cumsum(1), torch.rand(3, 29, 2)
    actions[:, :, 1] = 0.5
    actions[2, 7, 1] = 0.7  # outside the budget
    options = {"targets": [0, 1]} if kind == "absolute" else {}
    data, task = make_demonstrations(list(states), list(actions), control_hz=20, action_kind=kind, **options)
    data = select_state(data, task.state_of)
    labelled, _ = LabelBudget(episodes=(0, 1)).apply(data)
    ranges = command_ranges(task, labelled)
    assert ranges[1] == [0.5, 0.5] and constant_actions(task, ranges) == {1: 0.5}
    assert constant_actions(task, command_ranges(task, data)) == {}
    facts, decoded = policy_facts(task, ranges=ranges), torch.ones(1, 3, 2)
    assert facts["ranges"][1] is None and facts["ranges"][0] == ranges[0]
    expected = 3 if kind == "absolute" else 1
    assert facts["action_rule"](torch.full((1, 3, 3), 2.0), decoded)[0].tolist() == [[expected, 0.5]] * 3
    assert decoded.min() == 1
    told = replace(task, command=None) if kind != "delta" else replace(TASK, actions=task.actions)
    assert (constant_actions(told, ranges) == {}) == (kind == "delta"), "decoded commands are no changes"
    assert policy_facts(task)["action_rule"] == task.action_rule
