# This source code is licensed under the MIT license found in the LICENSE file.
"""What :func:`~torchrl_koap.modules.make_policy` is told of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.data import controller_view
from torchrl_koap.keys import ACTION, HAS_ACTION, LABEL_COMMAND, OBSERVATION, STATE
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.action_rules import ActionRule
from torchrl_koap.tasks.columns import unit_groups

PLACES = "absolute"  # preset of controllers that decode where the robot is to be


def policy_facts(
    task: Task,
    *,
    columns: Sequence[int] | None = None,
    preset: str = "default",
    gripper: Sequence[int] | None = None,
    ranges: Sequence[Sequence[float] | None] | None = None,
) -> dict[str, Any]:
    """The facts of a task as keyword arguments of :func:`~torchrl_koap.modules.make_policy`.

    ``columns`` of the state are those that the controller reads (default: all), ``preset`` is its variant, ``ranges``
    are those of :func:`command_ranges`. A ``gripper`` is its action column and the state column of its width: its
    number is read off planned widths, where the task has no rule for actions of its own.
    """
    rule = task.action_rule
    if rule is None and gripper is not None:
        rule = ActionRule((gripper[0], gripper[1]))
    return {
        "state_of": task.state_of,
        "columns": columns,
        "action_rule": rule,
        "changes": tuple(task.delta_actions),
        "commanded": None if task.targets else commanded_columns(task),
        "decodes_commands": decoded_commands(task, preset) is not None,
        "ranges": ranges,
        "max_steps": task.max_steps,
        "control_hz": task.control_hz,
        "origins": task.origins,
    }


def commanded_columns(task: Task) -> dict[str, list[int]] | None:
    """The columns of action, observation (``"commands"``) and state that belong to each command.

    None where the observation does not repeat the command, or it is not known what it moves.
    """
    actions = list(range(task.action_dim) if task.targets else task.delta_actions)
    moved = list(task.targets or task.moved_columns(or_robot=True))
    if task.command is None:
        return None
    commands = list(range(task.observation_dim))[task.command_columns][: len(actions)]
    if not actions or not len(actions) == len(moved) == len(commands):
        return None
    return {"states": moved, "commands": commands, "actions": actions}


def decoded_commands(task: Task, preset: str) -> dict[str, list[int]] | None:
    """The columns of :func:`commanded_columns` where a controller decodes commands whose changes are the actions.

    None for every other preset than :data:`PLACES`, and where no action is a change of a command.

    Raises:
        ValueError: if the observation does not repeat the last command, or it is not known what the commands move.
    """
    if preset != PLACES or not task.delta_actions:
        return None
    columns, what = commanded_columns(task), f"has no preset {PLACES!r}"
    if columns is None:
        check_commanded(task, what, range(task.action_dim), None)
        raise ValueError(f"task {task.name!r} {what}: it is not known which state columns its commands move")
    return columns


def controller_data(task: Task, section: ControllerConfig, data: TensorDictBase) -> TensorDictBase:
    """Flat data ``[N]`` as a controller sees them: its columns, and what actions are learned as.

    Absolute actions are learned as the distance to their targets, so are commands (:func:`decoded_commands`); other
    actions as they are. A labelled step whose command is not known is none.
    """
    view = controller_view(data, task.controller_columns(section.columns), targets=task.targets)
    decoded = decoded_commands(task, section.preset)
    if decoded is None:
        return view
    actions, moved = decoded["actions"], data[STATE][:, decoded["states"]]
    told = LABEL_COMMAND in data.keys()
    last = data[LABEL_COMMAND][:, : len(actions)] if told else data[OBSERVATION][:, decoded["commands"]]
    learned = view[ACTION].clone()
    learned[:, actions] += (last - moved).to(learned.dtype)
    known = view[HAS_ACTION] & ~learned.isnan().any(-1, keepdim=True)
    return view.set(ACTION, learned).set(HAS_ACTION, known)


def check_commanded(task: Task, what: str, told: Sequence[int], gripper: Sequence[int] | None) -> None:
    """Refuses a task whose observation does not repeat the last command, or with actions that nothing tells.

    ``what`` says what it cannot do then; ``told`` are the actions that are known, besides that of the gripper.
    """
    if task.command is None:
        lacks = "its observation has no part that repeats the last command (Task.command)"
        raise ValueError(f"task {task.name!r} {what}: {lacks}")
    rest = set(range(task.action_dim)) - set(told) - {gripper[0] if gripper else None}
    if rest:
        names = ", ".join(task.action_names[column] for column in sorted(rest))
        raise ValueError(f"task {task.name!r} {what}: nothing tells the actions {names}")


def command_ranges(task: Task, data: TensorDictBase) -> list[list[float] | None]:
    """Finds the range of the demonstrated commands.

    Few labels show few directions: changes of commands reach as far either way, and on every axis, as the largest one
    in their unit. An absolute command may be wherever a demonstration took the column that it is the target of.

    Of flat data ``[N]`` after the label budget was applied, the least and greatest number of every action column are
    returned, None for a gripper's and for one that never changes.
    """
    labelled, meanings = data[ACTION][data[HAS_ACTION].squeeze(-1)], list(task.actions.values())
    ranges: list[list[float] | None] = [None] * len(meanings)
    for columns in unit_groups(task.action_units).values():
        changes = [column for column in columns if meanings[column].kind == "delta"]
        if changes:
            largest = float(labelled[:, changes].abs().max())
            for column in changes:
                ranges[column] = [-largest, largest]
    for column, meaning in enumerate(meanings):
        if meaning.kind in ("absolute", "raw"):
            numbers = labelled[:, column]
            numbers = numbers if meaning.column is None else torch.cat([numbers, data[STATE][:, meaning.column]])
            ranges[column] = [float(numbers.min()), float(numbers.max())]
    return [None if ends is None or ends[0] == ends[1] else ends for ends in ranges]
