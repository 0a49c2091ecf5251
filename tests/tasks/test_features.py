# This source code is licensed under the MIT license found in the LICENSE file.
"""Observation columns to state columns, and the layouts of all tasks."""

from __future__ import annotations

import math

import pytest
import torch

from torchrl_koap.tasks import TASKS, WINDOW, get_task
from torchrl_koap.tasks.features import double_yaw, plane, yaw_of


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_double_yaw_is_continuous_and_unit_length(dtype):
    yaw = torch.linspace(-1.5707, 1.5707, 101, dtype=dtype)[:, None]
    found = double_yaw(yaw.tan())
    assert found.dtype == dtype
    expected = torch.cat([(2 * yaw).cos(), (2 * yaw).sin()], -1)
    assert torch.allclose(found, expected, atol=2e-3 if dtype == torch.float32 else 1e-9)
    # both ends of the range are one and the same direction
    assert torch.allclose(found[0], found[-1], atol=1e-3)


def test_poles_of_the_tangent_are_finite():
    found = double_yaw(torch.tensor([[math.inf], [-math.inf], [1e30]]))
    assert torch.allclose(found, torch.tensor([[-1.0, 0.0]]).expand(3, 2), atol=1e-6)


def test_gradients_of_features_are_finite():
    tangent = torch.tensor([[0.0], [3.0], [1e4]], requires_grad=True)
    double_yaw(tangent).sum().backward()
    assert tangent.grad.isfinite().all()


def test_yaw_of_quaternions_ignores_sign_and_a_small_tilt():
    yaw = torch.linspace(-3.1, 3.1, 25, dtype=torch.float64)
    zero = torch.zeros_like(yaw)
    upright = torch.stack([(yaw / 2).cos(), zero, zero, (yaw / 2).sin()], -1)
    expected = torch.stack([yaw.cos(), yaw.sin()], -1)
    assert torch.allclose(yaw_of(upright), expected) and torch.allclose(yaw_of(-upright), expected)
    tilt = torch.tensor([math.cos(0.02), math.sin(0.02), 0.0, 0.0], dtype=torch.float64)  # 2.3 deg about x, first
    w, _, _, z = upright.unbind(-1)
    tilted = torch.stack([w * tilt[0], w * tilt[1], z * tilt[1], z * tilt[0]], -1)
    assert (yaw_of(tilted) - expected).abs().max() < 2e-3


def test_plane_drops_the_height():
    assert plane(torch.tensor([1.0, 2.0, 3.0])).tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("name", "observed", "state"),
    [
        ("avoiding", 4, 2),
        ("aligning", 20, 11),
        ("sorting", 16, 18),
        ("sorting_2", 10, 10),
        ("sorting_6", 22, 26),
        ("po_sorting", 16, 10),
        ("stacking", 31, 26),
        ("stacking_1", 31, 26),
        ("stacking_unobserved_joints", 31, 19),
    ],
)
def test_sizes(name, observed, state):
    task = get_task(name)
    assert (task.observation_dim, task.state_dim) == (observed, state)
    slices = list(task.state_slices.values())
    assert slices[0].start == 0 and slices[-1].stop == state
    assert all(first.stop == second.start for first, second in zip(slices, slices[1:], strict=False))


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.command is not None])
def test_no_state_shows_the_command(name):
    """Whatever the commanded columns hold, NaN included, the state is the same."""
    task = get_task(name)
    observation = torch.randn(5, task.observation_dim)
    hidden = observation.clone()
    hidden[:, task.observation[task.command]] = torch.nan
    assert torch.equal(task.state_of(observation), task.state_of(hidden))
    assert not {*range(*task.observation[task.command].indices(99))} & {*task.state_columns}


@pytest.mark.parametrize("name", TASKS)
def test_facts_fit_each_other(name):
    task = get_task(name)
    assert {body.position for body in task.bodies} <= set(task.observation)
    command = set() if task.command is None else {task.command}
    assert {*task.state, *task.hidden, *command, task.position} <= set(task.observation)
    assert all(0 <= column < task.state_dim for column in (*task.moved_columns(or_robot=True), *task.robot))
    assert len(task.moved_columns()) in (0, task.action_dim)
    assert get_task(task.source).observation == task.observation
    assert WINDOW == 16


def test_wrong_observations_are_named():
    with pytest.raises(ValueError, match="task 'sorting' has 16 columns, got 4"):
        get_task("sorting").state_of(torch.zeros(2, 4))


def test_stacking_without_joints_shows_and_commands_what_the_paper_does():
    task, whole = get_task("stacking_unobserved_joints"), get_task("stacking_1")
    observation = torch.randn(3, task.observation_dim)
    hidden = observation.clone()
    hidden[:, task.observation["measured_joints"]] = torch.nan
    state = task.state_of(observation)
    assert torch.equal(state, task.state_of(hidden))
    assert torch.equal(state[:, :3], observation[:, task.observation["tcp_position"]])
    assert torch.equal(state[:, 3:4], observation[:, task.observation["gripper_width"]])
    assert torch.equal(state[:, 4:], whole.state_of(observation)[:, whole.state_slices["red_position"].start :])
    # joints and gripper are commanded, and the controller decodes both
    assert task.action_units == whole.action_units and task.action_rule is None and whole.action_rule is not None
    assert task.controller_columns("robot") == (0, 1, 2, 3) and task.source == "stacking"
