# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests the fit of the response on labelled steps: known systems, hidden labels, prediction errors."""

import math
from dataclasses import replace

import pytest
import torch
from small_networks import a_system, controller_of, plain_task
from tensordict import TensorDict

from torchrl_koap.data import flatten_trajectories, select_state
from torchrl_koap.modules import ResponseModel
from torchrl_koap.tasks import Action, Task, get_task
from torchrl_koap.training import response as response_fit
from torchrl_koap.training.response import (
    fit_response,
    labelled_steps,
    prediction_errors,
    tracked_columns,
)


def columns(**options) -> ResponseModel:
    return ResponseModel([0, 1], [0, 1], [0, 1], **options)


def recordings(episodes: int = 6, length: int = 60, noise: float = 0.0, across: float = 0.0) -> TensorDict:
    """Fully labelled flat data of the system, each episode at a place of its own: observation is command, position.

    The second axis also pulls the first one, by ``across``.
    """
    torch.manual_seed(0)
    system = a_system()
    system.weight[0, 1, 2] = across
    frames, actions = [], []
    for _ in range(episodes):
        action = (0.01 * torch.randn(length, 2, dtype=torch.float64)).cumsum(0) * 0.3
        start = torch.randn(1, 2, dtype=torch.float64)
        moved = system.predict(start.expand(3, 2), start[0], torch.zeros(2, 2, dtype=torch.float64), action)
        position, command = torch.cat([start, moved]), torch.cat([start, start + action.cumsum(0)])
        frames.append(torch.cat([command, position + noise * torch.randn_like(position)], -1))
        actions.append(action)
    return select_state(flatten_trajectories(frames, actions, dtype=torch.float64), (2, 3))


def test_the_system_is_found_from_one_labelled_trajectory():
    data, response = recordings(), columns()
    data["has_action"] = (data["episode"] == 2).unsqueeze(-1)
    found = fit_response(response, data)
    assert found["labels_used"] < 60 and found["held_out_error"] < 1e-4
    assert not found["coupled"] and not response.weight[0, 1].any() and not response.weight[1, 0].any()
    # the coordinates are nearly dependent: what counts is the answer to a command
    torch.testing.assert_close(response.double().impulse_matrix(8), a_system().impulse_matrix(8), atol=5e-3, rtol=0)


def test_axes_are_coupled_only_if_one_pulls_the_other():
    found = [fit_response(columns(), recordings(across=across))["coupled"] for across in (0.0, 0.05)]
    assert found == [False, True]


def test_segments_with_hidden_commands_have_their_own_offsets():
    data, response = recordings(), columns()
    labelled = (torch.arange(len(data)) % 30 < 16).unsqueeze(-1)
    data["has_action"] = labelled
    data["action"] = torch.where(labelled, data["action"], math.nan)
    data["observation"][:, :2] = math.nan
    found = fit_response(response, data)
    steps, _ = labelled_steps(response, data)
    assert not steps.known.any() and found["labels_used"] == len(steps.row)
    assert found["held_out_error"] < 1e-4
    # the coordinates are nearly dependent: what counts is the answer to a command
    torch.testing.assert_close(response.double().impulse_matrix(8), a_system().impulse_matrix(8), atol=5e-3, rtol=0)


def test_the_error_is_that_of_stretches_left_out():
    data, response = recordings(episodes=5, length=7, noise=0.01), columns()
    found = fit_response(response, data)
    steps, changes = labelled_steps(response, data)
    stretches = response_fit._stretches(response, data, steps, changes)
    assert found["held_out_error"] > 2 * prediction_errors(response, stretches).square().mean().sqrt()


def test_only_hidden_commands_are_known_up_to_a_constant():
    data, response = recordings(episodes=2, noise=0.01), columns()
    fit_response(response, data)
    stretches = response_fit._stretches(response, data, *labelled_steps(response, data))
    assert stretches.future.shape[1] == response_fit.AHEAD
    errors = []
    for known in (torch.arange(len(stretches)) % 2 == 0, torch.tensor(True), torch.tensor(False)):
        stretches.known = known.expand(len(stretches))
        errors.append(prediction_errors(response, stretches))
    mixed, all_known, all_hidden = errors
    torch.testing.assert_close(
        mixed, torch.where(torch.arange(len(mixed))[:, None, None] % 2 == 0, all_known, all_hidden)
    )
    assert all_hidden.square().sum() < all_known.square().sum()


def test_absolute_commands_give_the_same_model():
    data, delta, absolute = recordings(), columns(), columns(absolute=True)
    fit_response(delta, data)
    data["action"] = data["observation"][:, :2] + data["action"]
    data["observation"][:, :2] = math.nan  # not needed: an action is the command
    fit_response(absolute, data)
    torch.testing.assert_close(absolute.weight, delta.weight, atol=2e-3, rtol=0)


def test_hidden_labels_are_not_read():
    weights = []
    for poison in (0.0, 1e9):
        data = recordings()
        hidden = (data["episode"] > 1).unsqueeze(-1)
        data["has_action"] = ~hidden
        data["action"] = torch.where(hidden, poison, data["action"])
        data["observation"][:, :2] = torch.where(hidden, poison, data["observation"][:, :2])
        response = columns()
        fit_response(response, data)
        weights.append(response.weight.clone())
    assert torch.equal(*weights) and weights[0].any()


def test_steps_across_episodes_and_gaps_are_left_out():
    data = recordings(episodes=2, length=10)
    data["has_action"][4] = False
    steps, changes = labelled_steps(columns(), data)
    # two changes before, and one step after: rows 2..8 of each episode, but for those that need the change of row 4
    assert steps.row.tolist() == [2, 3, 4, 7, 8, 12, 13, 14, 15, 16, 17, 18]
    assert steps.segment.tolist() == [0] * 3 + [1] * 2 + [2] * 7
    assert changes[4].isnan().all() and not changes[5].isnan().any()


def test_too_few_labels_in_a_row_are_refused():
    data = recordings(episodes=1, length=20)
    data["has_action"][::2] = False
    with pytest.raises(ValueError, match="2 labelled steps in a row"):
        fit_response(columns(), data)
    assert fit_response(columns(), recordings(episodes=1, length=40))["held_out_error"] is None  # for five blocks


def test_predictions_that_are_worse_than_standing_still_are_refused():
    data = recordings()
    data["state"].copy_(data["observation"][:, :2])  # the robot is where it was told to be, at once
    data["state"] += 1e-9 * torch.randn_like(data["state"])
    with pytest.raises(ValueError, match="standing still one of .*without any lag"):
        fit_response(columns(), data)


def test_columns_of_the_tasks():
    assert tracked_columns(get_task("aligning"))["states"] == [0, 1, 2]
    stacking = tracked_columns(get_task("stacking"))
    assert stacking["actions"] == list(range(7)) == stacking["commands"] and len(stacking["states"]) == 7


def test_targets_are_told_from_changes():
    for kind in ("absolute", "delta"):
        task = replace(plain_task(2, 2), actions={f"a{n}": Action(kind=kind, column=n) for n in range(2)})
        assert tracked_columns(task)["absolute"] == (kind == "absolute")


def test_a_task_without_commands_is_refused_before_any_work():
    task = Task(
        name="arm", observation_parts={"joints": 2}, actions={"a": Action("rad"), "b": Action("rad")}, position="joints"
    )
    with pytest.raises(ValueError, match=r"task 'arm' .* repeats the last command \(Task.command\)"):
        controller_of("mpc", task=task)


# ---- the fit of predictions over many steps


def test_a_multi_step_fit_corrects_a_biased_single_step_fit(monkeypatch):
    """A sensor that errs by a little makes a regression of single steps forget momentum; predictions do not."""
    data, answers = recordings(episodes=8, noise=0.003), []
    for many in (True, False):
        response = columns().double()
        if not many:
            monkeypatch.setattr(response_fit, "fit_predictions", lambda *_, **__: None)
        found = fit_response(response, data)
        assert math.isfinite(found["held_out_error"])
        answers.append((response.impulse_matrix(12) - a_system().impulse_matrix(12)).square().mean().sqrt())
    assert answers[0] < 0.5 * answers[1]
