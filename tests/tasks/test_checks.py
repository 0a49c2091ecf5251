# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that all inconsistent arguments of a task are named in one error."""

from dataclasses import replace

import pytest
from toy_task import TOY

from torchrl_koap.tasks import Action, Body, Defaults, Modes, Scene, Task

HERE = (((0.0, 0.1), (0.0, 0.1)),)
BOX, LID = Body("box", "box_xy", starts=HERE), Body("lid", "box_xy", starts=HERE)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"position": "tol"}, "position: no part 'tol'; parts: command, tool"),
        ({"command": "order"}, "command: no part 'order'"),
        ({"actions": {}}, "actions: none"),
        ({"state": {"tool": "plan"}}, "state: part 'tool' has an unknown feature 'plan'; known: plain, plane"),
        ({"state": {"command": "plain"}}, "'command' repeats the command, which reveals hidden actions"),
        ({"hidden": ("tool", "box_xy", "box_tan_yaw")}, "state: no part is left"),
        ({"actions": {"x": "m"}}, r"actions: wanted 'x': Action\('m'\), got 'm'"),
        (
            {"actions": {"x": Action(kind="change")}},
            "actions: 'x' is of kind 'change'; known: delta, absolute, raw, gripper",
        ),
        ({"actions": {"x": Action(column=5)}}, "actions: the state has 5 columns, got 5"),
        ({"actions": {"x": Action(column=-1)}}, "actions: the state has 5 columns, got -1"),
        ({"actions": {"x": Action("", "raw", column=0)}}, "'x' is raw, which has no column, got column 0"),
        (
            {"actions": {"x": Action("", "raw")}, "defaults": Defaults(commands=True)},
            "defaults.commands: no action is the change of a command",
        ),
        ({"observation_parts": {}}, "observation_parts: none"),
        ({"observation_units": ("m",)}, "observation_units: wanted one for each of 7 columns, got 1"),
        ({"actions": {"x": Action("m", "gripper"), "y": Action("m", "gripper")}}, "at most one is a gripper"),
        ({"defaults": Defaults(joint_recovery=0.1)}, "defaults.joint_recovery: wanted tool_kinematics"),
        ({"robot": (0, 9)}, "robot: the state has 5 columns, got 9"),
        ({"interchangeable": (("box",),)}, "interchangeable: no body 'box'"),
        (
            {"scene": Scene(bodies=(BOX, LID)), "interchangeable": (("box", "lid"),)},
            r"wanted bodies with equally many state columns \(parts NAME_...\), got box 3, lid 0",
        ),
        ({"relative_positions": (("tool", "command"),)}, "'command' is no part of the state"),
        ({"planar_parts": ("tool", "box_tan_yaw")}, "planar_parts: 'box_tan_yaw' is neither a position"),
        (
            {"planar_parts": ("box_tan_yaw",), "state": {"tool": "plain", "box_tan_yaw": "tan_yaw"}},
            "planar_parts: 'box_tan_yaw' is neither a position",
        ),
        ({"observation_parts": {**TOY["observation_parts"], "more": ("tool_0",)}}, "columns named twice: tool_0"),
        (
            {"scene": Scene(bodies=(BOX, LID), shared_starts=HERE)},
            "scene: give shared_starts or starts of bodies, not both",
        ),
        ({"scene": Scene(bodies=(BOX, replace(LID, starts=())))}, "scene: body 'lid' has no start region"),
        (
            {"scene": Scene(bodies=(replace(BOX, starts=()), replace(LID, starts=())), shared_starts=HERE)},
            "scene.shared_starts: 1 regions for 2 bodies",
        ),
        ({"modes": Modes(entropy="some")}, "modes.entropy: wanted one of all, contexts, solved_contexts, got 'some'"),
        (
            {"modes": Modes((("side", ("left", "right")),), leaves=((0,),))},
            "modes.leaves: wanted one for each of 2 modes, got 1",
        ),
    ],
)
def test_facts_that_do_not_fit_are_named(change, fault):
    with pytest.raises(ValueError, match=fault):
        Task(**(TOY | change))


def test_all_faults_are_told_at_once():
    with pytest.raises(ValueError, match=r"2 fault\(s\) in task 'toy'") as error:
        Task(**(TOY | {"position": "tol", "hidden": ("bx",)}))
    assert "no part 'tol'" in str(error.value) and "no part 'bx'" in str(error.value)


@pytest.mark.parametrize("name", ["../x", "a/b", "a\\b", ".."])
def test_names_that_would_lead_out_of_a_folder_are_refused(name):
    with pytest.raises(ValueError, match="used in file names"):
        Task(**(TOY | {"name": name}))
