# This source code is licensed under the MIT license found in the LICENSE file.
"""Tests that tasks match docs/appendix/d3il.md, survive JSON, and name modes and goals as environments do."""

import itertools
import json
import math
import subprocess
import sys

import numpy as np
import pytest
import torch
from toy_task import TOY

from torchrl_koap.tasks import TASKS, Action, Body, Scene, Shape, Task, avoiding, get_task, sorting
from torchrl_koap.tasks.modes import note_arrivals


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
    # joints and gripper are commanded; the gripper follows planned widths, and only joints that are seen are subtracted
    assert task.action_units == whole.action_units and task.gripper == (7, 3) and whole.gripper == (7, 7)
    assert not task.action_rule.distances and len(whole.action_rule.distances) == 7
    assert task.controller_columns("robot") == (0, 1, 2, 3) and task.source == "stacking"


def test_actions_say_what_they_move():
    moving = {"x": Action("m", column=1), "y": Action("m", column=0)}
    task = Task(**(TOY | {"actions": moving, "robot": (3, 4)}))
    assert task.moved_columns() == (1, 0) and task.moves == {0: 1, 1: 0}
    assert task.action_rule is None and task.delta_actions == (0, 1)
    silent = Task(**(TOY | {"robot": (3, 4, 0)}))
    assert silent.moved_columns() == () and silent.moves == {0: 3, 1: 4}
    assert Task(**(TOY | {"robot": (3,)})).moves == {}
    for grip in (Action("", "raw"), Action("m", "gripper", column=4)):  # says nothing about the others
        assert Task(**(TOY | {"actions": moving | {"grip": grip}, "robot": (3, 4)})).moves == {0: 1, 1: 0}
    reached = Task(**(TOY | {"actions": {name: Action("m", "absolute", column=2) for name in "xy"}, "robot": (3, 4)}))
    assert reached.targets == reached.moves == {0: 2, 1: 2}
    assert reached.moved_columns() == () and reached.delta_actions == ()
    states = torch.arange(5.0).expand(1, 3, 5)
    assert reached.action_rule(states, torch.ones(1, 3, 2)).tolist() == [[[3.0, 3.0]] * 3]
    mixed = Task(**(TOY | {"actions": {"a": Action("rad"), "grip": Action("m", "gripper", column=4)}}))
    assert mixed.gripper == (1, 4) and mixed.delta_actions == (0,) and not mixed.targets
    part = Task(**(TOY | {"actions": {"grip": Action("", "raw"), "x": Action("m", "absolute", column=2)}}))
    assert part.targets == {1: 2} and part.distances == ((1, 2),) and part.moved_columns() == ()
    assert part.action_rule(states, torch.ones(1, 3, 2)).tolist() == [[[1.0, 3.0]] * 3]
    assert get_task("stacking").moved_columns() == ()  # its axes do not share a filter


def test_an_absolute_action_has_the_origin_of_its_target_behind_parts_of_another_width():
    given = {"pose": ("w", "i", "j", "k"), "arm": ("near", "far")}
    task = Task(
        name="far_away",
        observation_parts=given,
        observation_origin=(0.0, 0.0, 0.0, 0.0, 5.0, 1e6),
        position="arm",
        state={"pose": "quaternion", "arm": "plain"},  # two columns, then two
        actions={"turn": Action("rad"), "place": Action("m", "absolute", column=3)},
    )
    assert task.origins == (task.observation_origin, (0.0, 1e6))


def test_units_decide_nothing_but_which_errors_are_averaged():
    actions = {"a": Action("rad"), "grip": Action("N"), "b": Action("rad", "absolute")}
    task = Task(**(TOY | {"actions": actions}))
    assert task.delta_actions == (0, 1) and task.tool_columns is None and task.gripper is None


def test_columns_of_a_body_are_not_those_of_another_whose_name_begins_alike():
    parts = {"arm": 2, "cup_xy": 2, "cup_2_xy": 2, "cup_2_spin": 2, "cup_spin": 2, "cupboard": 1}
    bodies = tuple(Body(name, f"{name}_xy") for name in ("cup", "cup_2"))
    given = TOY | {"observation_parts": parts, "position": "arm", "command": None, "state": {}, "hidden": ()}
    task = Task(**given | {"scene": Scene(bodies=bodies), "interchangeable": (("cup", "cup_2"),)})
    assert task.interchangeable_columns() == [[[2, 3, 8, 9], [4, 5, 6, 7]]]


def test_a_region_is_covered_by_its_rectangle():
    covered = Shape.over(((0.2, 0.4), (-0.1, 0.5)), "region")
    assert (*covered.center, *covered.half) == pytest.approx((0.3, 0.2, 0.1, 0.3))


def test_only_a_task_that_names_no_code_is_stored_with_its_data():
    assert get_task("avoiding").definition() is None
    assert Task.from_json(Task(**TOY).definition()) == Task(**TOY)


def test_columns_of_a_task_by_their_use():
    assert get_task("aligning").planar_columns() == ([(0, 1), (3, 4), (7, 8)], [(5, 6), (9, 10)])
    assert get_task("sorting_2").interchangeable_columns() == []  # one box of each colour
    assert Task(**TOY).controller_columns("robot") == (0, 1, 2, 3, 4)  # of a task that does not name its robot
    assert get_task("avoiding").plans_position and not get_task("stacking").plans_position


@pytest.mark.parametrize("name", list(TASKS))
def test_every_task_survives_json(name):
    task = get_task(name)
    written = json.dumps(task.to_json())
    read = Task.from_json(json.loads(written))
    assert read == task and json.dumps(read.to_json()) == written


def test_json_of_another_kind_is_refused():
    entries = get_task("avoiding").to_json()
    with pytest.raises(ValueError, match="unknown option 'colour'"):
        Task.from_json(entries | {"colour": 1})
    with pytest.raises(ValueError, match="unknown option of scene.shapes 'size'"):
        Task.from_json(entries | {"scene": {"shapes": [{"size": 1}]}})
    with pytest.raises(ValueError, match="option actions is missing"):
        Task.from_json({key: value for key, value in entries.items() if key != "actions"})
    with pytest.raises(ValueError, match=r"must be an object, got \[\]"):
        Task.from_json([])
    with pytest.raises(TypeError, match="not JSON serializable"):
        Task(**TOY, goal=len).to_json()


def test_the_package_loads_no_task_and_a_task_no_simulator(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)  # with it, MuJoCo is imported first
    code = (
        "import sys, torchrl_koap; assert torchrl_koap.__version__;"
        "assert not {'torch', 'torchrl_koap.tasks'} & set(sys.modules);"
        "torchrl_koap.get_task('stacking').state_dim; print([m for m in ('mujoco', 'gymnasium') if m in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert found.stdout.strip() == "[]", found.stderr


def passed(mode):
    """The flags of Avoiding's environment whose numbers are those of a mode."""
    flags = torch.zeros(9, dtype=torch.int64)
    flags[[mode // 12, 2 + mode % 12 // 4, 5 + mode % 4]] = 1
    return flags


ORDERS = torch.tensor(list(itertools.permutations(range(3))))
# leaves `mode` of the environments, and how their modes are called
LEAVES = {
    "avoiding": (
        torch.stack([passed(mode) for mode in range(24)]),
        itertools.product(("left", "right"), ("left", "middle", "right"), ("gap 1", "gap 2", "gap 3", "gap 4")),
    ),
    "aligning": (torch.tensor([[0], [1]]), [("inside",), ("outside",)]),
    "stacking": (ORDERS, itertools.permutations(("red", "green", "blue"))),
    "stacking_1": (ORDERS[::2], [("red",), ("green",), ("blue",)]),
}
for _name, _boxes in {"sorting": 4, "sorting_2": 2, "sorting_6": 6, "po_sorting": 4}.items():
    _orders = sorting.arrival_orders(_boxes)
    LEAVES[_name] = torch.tensor(_orders), [[("red", "blue")[colour] for colour in order] for order in _orders]


@pytest.mark.parametrize("name", LEAVES)
def test_modes_are_numbered_and_named_as_the_environment_tells_them(name):
    leaves, words = LEAVES[name]
    modes = TASKS[name].modes
    assert modes.index_of(leaves).tolist() == list(range(modes.number))
    assert [modes.name_of(mode) for mode in range(modes.number)] == [", ".join(each) for each in words]
    assert modes.name_of(modes.number) == modes.name_of(-1) == "no mode"
    undecided = leaves.clone()
    undecided[:, :2] = 0 if name == "avoiding" else -1
    assert (modes.index_of(undecided) == -1).all()
    assert modes.index_of(leaves.expand(2, -1, -1)).shape == (2, modes.number)


def test_a_leaf_of_another_task_is_refused():
    with pytest.raises(ValueError, match=r"mode must have 9 entries on the last axis, got shape \[3, 8\]"):
        TASKS["avoiding"].modes.index_of(torch.zeros(3, 8))


def test_a_path_of_avoiding_tells_its_mode():
    path = np.array([[0.55, -0.12], [0.45, -0.09], [0.5, 0.08], [0.6, 0.3], [0.3, 0.31]])  # the first frame decides
    assert avoiding.mode_of_path(path) == 18 and avoiding.mode_of_path(path[:3]) == -1


def test_avoiding_ends_behind_the_line():
    states = torch.tensor([[0.3, 0.351], [0.4, 0.35], [0.5, 0.3]])
    assert get_task("avoiding").goal_reached(states).tolist() == [True, False, False]


def aligned(distance, degrees):
    state = torch.zeros(11, dtype=torch.float64)
    angle = torch.tensor(math.radians(degrees), dtype=torch.float64)
    state[3:7] = torch.stack([torch.tensor(0.5 + distance), torch.tensor(0.25), angle.cos(), angle.sin()])
    state[7:11] = torch.tensor([0.5, 0.25, 1.0, 0.0])
    return get_task("aligning").goal_reached(state).item()


def test_aligning():
    assert aligned(0.015, 8.0) and not aligned(0.016, 0.0) and not aligned(0.0, 9.0) and not aligned(0.0, 180.0)


def test_sorting_needs_every_box_in_its_own_bin():
    task = get_task("sorting")
    good = torch.zeros(task.observation_dim)
    for box, place in {"red_1": 0.35, "red_2": 0.45, "blue_1": 0.6, "blue_2": 0.7}.items():
        good[task.observation[f"{box}_xy"]] = torch.tensor([place, 0.3])
    wrong, late = good.clone(), good.clone()
    wrong[task.observation["red_2_xy"]] = torch.tensor([0.6, 0.3])
    late[task.observation["blue_1_xy"]] = torch.tensor([0.6, 0.2])
    assert task.goal_reached(task.state_of(torch.stack([good, wrong, late]))).tolist() == [True, False, False]
    partial = get_task("po_sorting")
    assert partial.goal_reached(partial.state_of(torch.stack([good, wrong]))).tolist() == [True, False]


def test_stacking():
    task, single = get_task("stacking"), get_task("stacking_1")
    frames = torch.zeros(3, task.observation_dim)
    for index, box in enumerate(task.objects):
        part = task.observation[f"{box}_position"]
        frames[0, part] = torch.tensor([0.5, 0.2 + 0.01 * index, 0.01 + 0.06 * index])
        frames[1, part] = torch.tensor([0.5, 0.2, 0.01])  # all at one height
        frames[2, part] = torch.tensor([0.5, 0.2 + 0.05 * index, 0.01])
    assert task.goal_reached(task.state_of(frames)).tolist() == [True, False, False]
    assert single.goal_reached(single.state_of(frames)).tolist() == [True, True, True]
    assert not single.goal_reached(single.state_of(torch.zeros(1, 31))).item()


def test_states_of_another_size_are_refused():
    with pytest.raises(ValueError, match="a state of task 'aligning' has 11 columns, got 2"):
        get_task("aligning").goal_reached(torch.zeros(1, 2))


def test_the_nearest_body_that_is_not_noted_arrives_if_it_is_inside():
    orders = np.array([[-1, -1, -1], [2, -1, -1], [0, -1, -1], [2, 0, 1]])
    inside = np.array([[True, True, True], [True, True, True], [True, True, False], [True, True, True]])
    note_arrivals(orders, np.array([[0.3, 0.1, 0.2], [0.1, 0.2, 0.0], [0.0, 0.2, 0.1], [0.1, 0.1, 0.1]]), inside)
    assert orders.tolist() == [[1, -1, -1], [2, 0, -1], [0, -1, -1], [2, 0, 1]]


def test_a_stored_constant_of_an_action_is_ignored():
    task = Task(**TOY)
    stored = task.to_json()
    for action in stored["actions"].values():
        action["constant"] = 0.5
    assert Task.from_json(stored) == task and stored["actions"]["x"]["constant"] == 0.5
    with pytest.raises((TypeError, ValueError), match="steady"):
        Task.from_json(stored | {"actions": {"x": {"steady": 1}}})
