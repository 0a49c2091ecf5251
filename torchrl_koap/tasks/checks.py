# This source code is licensed under the MIT license found in the LICENSE file.
"""Checks that the fields of a task are consistent."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, get_args

from torchrl_koap.tasks.action_rules import Action, ActionKind
from torchrl_koap.tasks.columns import FEATURES

if TYPE_CHECKING:
    from torchrl_koap.tasks.task import Task

ENTROPIES = ("all", "contexts", "solved_contexts")


def check_task(task: Task) -> None:
    """Raises a ValueError that lists all faults of a task."""
    faults = [*_own_faults(task), *_action_faults(task), *(list(_part_faults(task)) or _column_faults(task))]
    faults += _body_faults(task)
    if faults:
        raise ValueError(f"{len(faults)} fault(s) in task {task.name!r}:\n  - " + "\n  - ".join(faults))


def _own_faults(task: Task) -> Iterator[str]:
    if not task.name or not isinstance(task.name, str):
        yield f"name: wanted a name, got {task.name!r}"
    elif set("/\\") & set(task.name) or task.name in (".", ".."):
        yield f"name: used in file names, so it may hold no / or \\, got {task.name!r}"
    if not task.observation_parts:
        yield "observation_parts: none"
    if task.modes.entropy not in ENTROPIES:
        yield f"modes.entropy: wanted one of {', '.join(ENTROPIES)}, got {task.modes.entropy!r}"
    if len(task.modes.leaves) not in (0, task.modes.number):
        yield f"modes.leaves: wanted one for each of {task.modes.number} modes, got {len(task.modes.leaves)}"


def _action_faults(task: Task) -> Iterator[str]:
    if not task.actions:
        yield "actions: none"
    actions: Mapping[str, Any] = task.actions
    invalid = {name: action for name, action in actions.items() if not isinstance(action, Action)}
    if invalid:
        yield from (f"actions: wanted {name!r}: Action({given!r}), got {given!r}" for name, given in invalid.items())
        return
    for name, action in actions.items():
        if action.kind not in get_args(ActionKind):
            yield f"actions: {name!r} is of kind {action.kind!r}; known: {', '.join(get_args(ActionKind))}"
        elif action.kind == "raw" and action.column is not None:
            yield f"actions: {name!r} is raw, which has no column, got column {action.column}"
    if task.defaults.commands and (task.command is None or not task.delta_actions):
        yield "defaults.commands: no action is the change of a command that the observation repeats (command)"
    if task.defaults.joint_recovery and task.tool_kinematics is None:
        yield "defaults.joint_recovery: wanted tool_kinematics, without which recovery is that of the joints"
    if sum(action.kind == "gripper" for action in actions.values()) > 1:
        yield "actions: at most one is a gripper"


def _part_faults(task: Task) -> Iterator[str]:
    named = {
        "position": (task.position,),
        "command": () if task.command is None else (task.command,),
        "state": task.state,
        "hidden": task.hidden,
        "scene.bodies": [part for body in task.bodies for part in (body.position, body.yaw) if part],
    }
    for field, names in named.items():
        for part in names:
            if part not in task.observation_parts:
                yield f"{field}: no part {part!r}; parts: {', '.join(task.observation_parts)}"
    for part, kind in task.state.items():
        if kind not in FEATURES:
            yield f"state: part {part!r} has an unknown feature {kind!r}; known: {', '.join(sorted(FEATURES))}"
    if task.command is not None and task.command in task.state:
        yield f"state: {task.command!r} repeats the command, which reveals hidden actions"


def _column_faults(task: Task) -> Iterator[str]:
    if not task.state_parts:
        yield "state: no part is left besides the command and the hidden parts"
        return
    names = task.observation_names
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        yield f"observation_parts: columns named twice: {', '.join(twice)}"
    moved = [action.column for action in task.actions.values() if isinstance(action, Action)]
    for field, columns in {"actions": moved, "robot": task.robot}.items():
        wrong = [column for column in columns if column is not None and not 0 <= column < task.state_dim]
        if wrong:
            yield f"{field}: the state has {task.state_dim} columns, got {wrong[0]}"
    said = {"observation_units": task.observation_units, "observation_origin": task.observation_origin}
    for field, values in said.items():
        if len(values) not in (0, task.observation_dim):
            yield f"{field}: wanted one for each of {task.observation_dim} columns, got {len(values)}"
    for name in (*(name for group in task.relative_positions for name in group), *task.planar_parts):
        if name not in task.state_parts:
            yield f"relative_positions or planar_parts: {name!r} is no part of the state"
    for name in task.planar_parts:
        part = task.state_slices.get(name, slice(0, 2))
        if task.state_parts.get(name) == "tan_yaw" or part.stop - part.start < 2:
            yield f"planar_parts: {name!r} is neither a position (x, y) nor a quaternion"
    for group in task.interchangeable:
        widths = {name: len(task.body_columns(name)) for name in group if name in task.objects}
        if 0 in widths.values() or len(set(widths.values())) > 1:
            got = ", ".join(f"{name} {width}" for name, width in widths.items())
            yield f"interchangeable: wanted bodies with equally many state columns (parts NAME_...), got {got}"


def _body_faults(task: Task) -> Iterator[str]:
    for name in (name for group in task.interchangeable for name in group):
        if name not in task.objects:
            yield f"interchangeable: no body {name!r}"
    shared, without = len(task.scene.shared_starts), [body.name for body in task.bodies if not body.starts]
    if shared and len(without) < len(task.bodies):
        yield "scene: give shared_starts or starts of bodies, not both"
    elif shared and shared < len(task.bodies):
        yield f"scene.shared_starts: {shared} regions for {len(task.bodies)} bodies"
    elif not shared and 0 < len(without) < len(task.bodies):
        yield from (f"scene: body {name!r} has no start region" for name in without)
