# This source code is licensed under the MIT license found in the LICENSE file.
"""Facts of the tasks are consistent with each other and with the specification."""

from __future__ import annotations

import dataclasses
import math

import pytest

from torchrl_koap.tasks import TASKS, Task, get_task


def test_avoiding_follows_the_specification():
    task = get_task("avoiding")
    assert task.observation_dim == 4
    assert task.action_dim == 2
    assert task.observation[task.command] == slice(0, 2)
    assert task.state_columns == (2, 3)
    assert task.max_steps == 250
    assert task.num_modes == 24
    assert math.isclose(task.control_hz, 28.5714, rel_tol=1e-4)


@pytest.mark.parametrize("name", TASKS)
def test_columns_of_every_task(name):
    task = TASKS[name]
    assert task.name == name
    covered = [column for part in task.observation.values() for column in range(part.start, part.stop)]
    assert covered == list(range(task.observation_dim))  # no gap, no overlap, in order
    command = task.observation[task.command]
    assert not set(range(command.start, command.stop)) & set(task.state_columns)
    assert set(task.hidden) < set(task.observation)


def test_hidden_parts_are_no_state():
    task = Task(
        name="toy",
        observation_parts={"desired": 1, "measured": 2, "yaw": 1, "box": 2},
        command="desired",
        position="measured",
        actions={"x": "m"},
        hidden=("yaw",),
    )
    assert task.state_columns == (1, 2, 4, 5)
    assert task.observation_dim == 6 and task.num_modes == 1


def test_unknown_names_suggest_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'avoiding'"):
        get_task("avoidng")
    with pytest.raises(ValueError, match="known: .*avoiding"):
        get_task("xyz")
    for wrong in (None, 3, ["avoiding"]):
        with pytest.raises(ValueError, match="unknown task"):
            get_task(wrong)


def test_tasks_cannot_be_changed():
    with pytest.raises(dataclasses.FrozenInstanceError):
        get_task("avoiding").max_steps = 3
