# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that tasks are found by name: registered ones, and those of installed packages."""

import importlib.metadata
from unittest.mock import patch

import pytest
from toy_task import TOY

from torchrl_koap.tasks import TASKS, Modes, Task, get_task, register_task
from torchrl_koap.tasks import registry as registry_module


def test_unknown_names_suggest_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'avoiding'"):
        get_task("avoidng")
    with pytest.raises(ValueError, match="known: .*avoiding"):
        get_task("xyz")
    for wrong in (None, 3, ["avoiding"]):
        with pytest.raises(ValueError, match="unknown task"):
            get_task(wrong)


@pytest.fixture
def tasks(monkeypatch):
    with patch.dict(TASKS):
        yield TASKS


def test_a_task_may_be_registered_again_but_no_other_of_its_name(tasks):
    first = register_task(Task(**TOY))
    assert register_task(first) is first and register_task(Task(**TOY)) is first and get_task("toy") is first
    with pytest.raises(ValueError, match=r"another task named 'toy' is registered already.*TASKS\['toy'\]"):
        register_task(Task(**TOY, max_steps=7))
    with pytest.raises(TypeError, match="wanted a Task, got dict"):
        register_task(TOY)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *((field, "my_package:code") for field in ("env", "expert", "goal", "score", "tool_kinematics")),
        ("modes", Modes(of_path="my_package:code")),
    ],
)
def test_a_task_that_somebody_sent_may_name_no_code(field, value):
    entries = Task(**(TOY | {"name": "sent", field: value})).to_json()
    with pytest.raises(ValueError, match=f"task 'sent' names code in {field}"):
        registry_module.task_from("sent", entries)


class Point:
    name, value = "mine", "my_package.my_task"

    def __init__(self, load):
        self.load = load


def test_entry_points_are_asked_when_a_name_is_unknown(tasks, monkeypatch):
    asked = []

    def points(group):
        asked.append(group)
        return [Point(lambda: Task(**TOY))]

    monkeypatch.setattr(importlib.metadata, "entry_points", points)
    get_task("avoiding")
    assert not asked
    assert get_task("toy").observation_dim == 7
    assert get_task("toy") and asked == ["torchrl_koap.tasks"]
    with pytest.raises(ValueError, match="unknown task 'to'"):
        get_task("to")


def test_a_broken_entry_point_is_named(tasks, monkeypatch):
    def fail():
        raise ImportError("no module named 'my_package'")

    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [Point(fail)])
    with pytest.raises(ValueError, match="'mine' = 'my_package.my_task' of 'torchrl_koap.tasks' .*no module named"):
        get_task("toy")
