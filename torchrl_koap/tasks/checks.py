# This source code is licensed under the MIT license found in the LICENSE file.
"""Whether the facts of a task fit each other."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, get_args

from torchrl_koap.tasks.action_rules import Action, ActionKind
from torchrl_koap.tasks.columns import FEATURES

if TYPE_CHECKING:
    from torchrl_koap.tasks.task import Task

ENTROPIES = ("all", "contexts", "solved_contexts")


def check_task(task: Task) -> None:
    """Checks a task."""
    faults = [] if task.name and isinstance(task.name, str) else [f"name: wanted a name, got {task.name!r}"]
    if not faults and (set("/\\") & set(task.name) or task.name in (".", "..")):
        faults.append(f"name: part of the names of files, it may hold no / or \\, got {task.name!r}")
    if not task.observation_parts:
        faults.append("observation_parts: none")
    faults += _action_faults(task)
    faults += _part_faults(task) or _column_faults(task)
    faults += _body_faults(task)
    if task.modes.entropy not in ENTROPIES:
        faults.append(f"modes.entropy: wanted one of {', '.join(ENTROPIES)}, got {task.modes.entropy!r}")
    if faults:
        raise ValueError(f"{len(faults)} fault(s) in task {task.name!r}:\n  - " + "\n  - ".join(faults))


def _action_faults(task: Task) -> list[str]:
    if not task.actions:
        return ["actions: none"]
    faults = []
    given: Mapping[str, Any] = task.actions
    for name, action in given.items():
        if not isinstance(action, Action):
            faults.append(f"actions: wanted {name!r}: Action({action!r}), got {action!r}")
        elif action.kind not in get_args(ActionKind):
            faults.append(f"actions: {name!r} is of kind {action.kind!r}; known: {', '.join(get_args(ActionKind))}")
    if faults:
        return faults
    with_target = [action.kind == "absolute" and action.column is not None for action in task.actions.values()]
    if any(with_target) and not all(with_target):
        faults.append("actions: all are absolute and name the column that they are the target of, or none names one")
    faults += [
        f"actions: {name!r} is raw, of which no column is known, got column {action.column}"
        for name, action in task.actions.items()
        if action.kind == "raw" and action.column is not None
    ]
    if task.defaults.commands and (task.command is None or not task.delta_actions):
        faults.append("defaults.commands: no action is the change of a command that the observation repeats (command)")
    if sum(action.kind == "gripper" for action in task.actions.values()) > 1:
        faults.append("actions: at most one is a gripper")
    return faults


def _part_faults(task: Task) -> list[str]:
    named = {
        "position": (task.position,),
        "command": () if task.command is None else (task.command,),
        "state": task.state,
        "hidden": task.hidden,
        "scene.bodies": [part for body in task.bodies for part in (body.position, body.yaw) if part],
    }
    parts = task.observation_parts
    faults = [
        f"{field}: no part {part!r}; parts: {', '.join(parts)}"
        for field, names in named.items()
        for part in names
        if part not in parts
    ]
    for part, kind in task.state.items():
        if isinstance(kind, str) and kind not in FEATURES and ":" not in kind:
            faults.append(f"state: part {part!r} has an unknown feature {kind!r}; known: {', '.join(sorted(FEATURES))}")
    if task.command is not None and task.command in task.state:
        faults.append(f"state: {task.command!r} repeats the command, which gives hidden actions away")
    return faults


def _column_faults(task: Task) -> list[str]:
    if not task.state_parts:
        return ["state: nothing remains without the command and the hidden parts"]
    faults = []
    names = task.observation_names
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        faults.append(f"observation_parts: columns named twice: {', '.join(twice)}")
    if all(kind in FEATURES for kind in task.state_parts.values()):
        moved = [action.column for action in task.actions.values() if isinstance(action, Action)]
        for field, columns in {"actions": moved, "robot": task.robot}.items():
            wrong = [column for column in columns if column is not None and not 0 <= column < task.state_dim]
            if wrong:
                faults.append(f"{field}: the state has {task.state_dim} columns, got {wrong[0]}")
    said = {"observation_units": task.observation_units, "observation_origin": task.observation_origin}
    faults += [
        f"{field}: wanted one for each of {task.observation_dim} columns, got {len(values)}"
        for field, values in said.items()
        if len(values) not in (0, task.observation_dim)
    ]
    missing = [name for group in task.relative_positions for name in group if name not in task.state_parts]
    missing += [name for name in task.planar_parts if name not in task.state_parts]
    faults += [f"relative_positions or planar_parts: {name!r} is no part of the state" for name in missing]
    return faults


def _body_faults(task: Task) -> list[str]:
    named = [name for group in task.interchangeable for name in group]
    faults = [f"interchangeable: no body {name!r}" for name in named if name not in task.objects]
    shared, without = len(task.scene.shared_starts), [body.name for body in task.bodies if not body.starts]
    if shared and len(without) < len(task.bodies):
        faults.append("scene: bodies have starts of their own or share them, not both")
    elif shared and shared < len(task.bodies):
        faults.append(f"scene.shared_starts: {shared} regions for {len(task.bodies)} bodies")
    elif not shared and 0 < len(without) < len(task.bodies):
        faults += [f"scene: no region is for the body {name!r}" for name in without]
    return faults
