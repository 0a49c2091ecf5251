# This source code is licensed under the MIT license found in the LICENSE file.
"""Facts of the tasks are consistent with each other and with docs/d3il.md."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys

import pytest

import torchrl_koap
from torchrl_koap.tasks import TASKS, Action, Modes, Task, get_task, register_task
from torchrl_koap.tasks import registry as registry_module


def test_facts_of_avoiding():
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
    command = slice(0, 0) if task.command is None else task.observation[task.command]
    assert not set(range(command.start, command.stop)) & set(task.state_columns)
    assert set(task.hidden) < set(task.observation)


def test_hidden_parts_are_no_state():
    task = Task(
        name="toy",
        observation_parts={"desired": 1, "measured": 2, "yaw": 1, "box": 2},
        command="desired",
        position="measured",
        actions={"x": Action("m")},
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


TOY = {
    "name": "toy",
    "observation_parts": {"command": 2, "tool": 2, "box_xy": 2, "box_tan_yaw": 1},
    "actions": {"x": Action("m"), "y": Action("m")},
    "position": "tool",
    "command": "command",
}


@pytest.fixture
def tasks(monkeypatch):
    """The registry, as it was after the test."""
    known = dict(TASKS)
    yield TASKS
    TASKS.clear()
    TASKS.update(known)


def test_a_task_may_be_registered_again_but_no_other_of_its_name(tasks):
    first = register_task(Task(**TOY))
    assert register_task(first) is first and register_task(Task(**TOY)) is first and get_task("toy") is first
    with pytest.raises(ValueError, match="another task named 'toy' is registered already"):
        register_task(Task(**TOY, max_steps=7))
    with pytest.raises(TypeError, match="wanted a Task, got dict"):
        register_task(TOY)


class Point:
    name, value = "mine", "my_package.my_task"

    def __init__(self, load):
        self.load = load


def test_entry_points_are_asked_once_and_when_a_name_is_unknown(tasks, monkeypatch):
    asked = []

    def points(group):
        asked.append(group)
        return [Point(lambda: Task(**TOY))]

    monkeypatch.setattr(registry_module, "_loaded", False)
    monkeypatch.setattr(registry_module, "entry_points", points)
    get_task("avoiding")
    assert not asked
    assert get_task("toy").observation_dim == 7
    with pytest.raises(ValueError, match="unknown task 'to'"):
        get_task("to")
    assert asked == ["torchrl_koap.tasks"]


def test_a_broken_entry_point_is_named(tasks, monkeypatch):
    def fail():
        raise ImportError("no module named 'my_package'")

    monkeypatch.setattr(registry_module, "_loaded", False)
    monkeypatch.setattr(registry_module, "entry_points", lambda group: [Point(fail)])
    with pytest.raises(RuntimeError, match="entry point 'mine' = 'my_package.my_task' .* no module named"):
        get_task("toy")


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"position": "tol"}, "position: no part 'tol'; parts: command, tool"),
        ({"command": "order"}, "command: no part 'order'"),
        ({"actions": {}}, "actions: none"),
        ({"state": {"tool": "plan"}}, "state: part 'tool' has an unknown feature 'plan'; known: plain, plane"),
        ({"state": {"command": "plain"}}, "'command' repeats the command, which gives hidden actions away"),
        ({"hidden": ("tool", "box_xy", "box_tan_yaw")}, "state: nothing remains"),
        ({"actions": {"x": "m"}}, r"actions: wanted 'x': Action\('m'\), got 'm'"),
        (
            {"actions": {"x": Action(kind="change")}},
            "actions: 'x' is of kind 'change'; known: delta, absolute, gripper",
        ),
        ({"actions": {"x": Action(column=5)}}, "actions: the state has 5 columns, got 5"),
        ({"actions": {"x": Action("m", "absolute", 0), "y": Action()}}, "name the column .* or none names one"),
        ({"actions": {"x": Action("m", "gripper"), "y": Action("m", "gripper")}}, "at most one is a gripper"),
        ({"robot": (0, 9)}, "robot: the state has 5 columns, got 9"),
        ({"interchangeable": (("box",),)}, "interchangeable: no body 'box'"),
        ({"relative_positions": (("tool", "command"),)}, "'command' is no part of the state"),
        ({"observation_parts": {**TOY["observation_parts"], "more": ("tool_0",)}}, "columns named twice: tool_0"),
        ({"modes": Modes(entropy="some")}, "modes.entropy: wanted one of all, contexts, solved_contexts, got 'some'"),
    ],
)
def test_facts_that_do_not_fit_are_named(change, fault):
    with pytest.raises(ValueError, match=fault):
        Task(**(TOY | change))


def test_all_faults_are_told_at_once():
    with pytest.raises(ValueError, match=r"2 fault\(s\) in task 'toy'") as error:
        Task(**(TOY | {"position": "tol", "hidden": ("bx",)}))
    assert "no part 'tol'" in str(error.value) and "no part 'bx'" in str(error.value)


def test_columns_have_names():
    task = Task(**(TOY | {"state": {"tool": "plain", "box_tan_yaw": "tan_yaw"}}))
    assert task.observation_names[:2] == ("command_0", "command_1") and task.observation_names[-1] == "box_tan_yaw"
    assert task.state_names == ("tool_0", "tool_1", "box_tan_yaw_cos_2yaw", "box_tan_yaw_sin_2yaw")
    assert task.state_dim == 4 and task.action_names == ("x", "y")


def test_units_decide_nothing_but_which_errors_are_averaged():
    actions = {"a": Action("rad"), "grip": Action("N"), "b": Action("rad", "absolute")}
    task = Task(**(TOY | {"actions": actions}))
    assert task.action_columns() == [0, 2] and task.action_columns("N") == [1] and task.action_columns("m") == []
    assert task.delta_actions == (0, 1) and task.tool_columns is None and task.gripper is None


def test_a_feature_of_ones_own_is_an_import_string():
    import torch

    task = Task(**(TOY | {"state": {"tool": "plain", "box_xy": "torch:sin"}}))
    assert task.state_dim == 4 and task.state_names[2:] == ("box_xy_0", "box_xy_1")
    observation = torch.arange(7.0)[None]
    torch.testing.assert_close(task.state_of(observation), torch.tensor([[2.0, 3.0, *torch.arange(4.0, 6.0).sin()]]))
    broken = Task(**(TOY | {"state": {"tool": "torch:sinus"}}))
    with pytest.raises(ValueError, match="a feature of task 'toy': module 'torch' has no 'sinus'"):
        broken.state_of(observation)


@pytest.mark.parametrize("name", list(TASKS))
def test_every_task_survives_json(name):
    task = get_task(name)
    written = json.dumps(task.to_json())
    read = Task.from_json(json.loads(written))
    assert read == task and json.dumps(read.to_json()) == written


def test_json_of_another_kind_is_refused():
    entries = get_task("avoiding").to_json()
    with pytest.raises(ValueError, match="task: unknown entry 'colour'"):
        Task.from_json(entries | {"colour": 1})
    with pytest.raises(ValueError, match=r"scene.shapes: unknown entry 'size'"):
        Task.from_json(entries | {"scene": {"shapes": [{"size": 1}]}})
    with pytest.raises(ValueError, match="task: entry 'actions' is missing"):
        Task.from_json({key: value for key, value in entries.items() if key != "actions"})
    with pytest.raises(ValueError, match="task: wanted an object, got list"):
        Task.from_json([])
    with pytest.raises(TypeError, match="goal cannot be written to JSON: wanted an import string"):
        Task(**TOY, goal=len).to_json()


def test_the_package_loads_no_task_and_a_task_no_simulator():
    code = (
        "import sys, torchrl_koap; assert torchrl_koap.__version__; assert 'torchrl_koap.tasks' not in sys.modules;"
        "torchrl_koap.get_task('stacking').state_dim; print([m for m in ('mujoco', 'gymnasium') if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.stdout.strip() == "[]", found.stderr
    with pytest.raises(AttributeError, match="has no attribute 'register_tusk'"):
        torchrl_koap.register_tusk  # noqa: B018


@pytest.mark.parametrize("name", ["../x", "a/b", "a\\b", ".."])
def test_names_that_would_lead_out_of_a_folder_are_refused(name):
    with pytest.raises(ValueError, match="part of the names of files"):
        Task(name=name, observation_parts={"xy": 2}, actions={"x": Action("m")}, position="xy")
