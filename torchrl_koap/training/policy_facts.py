# This source code is licensed under the MIT license found in the LICENSE file.
"""Facts of a task about its data for controllers, and about the robot for :func:`~torchrl_koap.modules.make_policy`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.data.quality import constant_columns
from torchrl_koap.keys import ACTION, HAS_ACTION, LABEL_COMMAND, OBSERVATION, STATE
from torchrl_koap.modules.planning.denoisers import RelativePositionFeatures
from torchrl_koap.modules.windows import StateReader
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.action_rules import ActionRule, shift_actions
from torchrl_koap.tasks.columns import unit_groups
from torchrl_koap.training.method import Method


def policy_facts(
    task: Task, *, reads: StateReader | None = None, ranges: Sequence[Sequence[float] | None] | None = None
) -> dict[str, Any]:
    """Returns the facts of a task as keyword arguments of :func:`~torchrl_koap.modules.make_policy`.

    ``reads`` is what the controller reads of states (default: all columns), ``ranges`` are those of
    :func:`command_ranges`.
    """
    constants, rule = constant_actions(task, ranges or ()), task.action_rule
    return {
        "state_of": task.state_of,
        "reads": reads,
        "action_rule": replace(rule or ActionRule(), constants=constants) if constants else rule,
        "changes": tuple(task.delta_actions),
        "commanded": None if task.targets else commanded_columns(task),
        "decoded": decoded_commands(task),
        "ranges": None if ranges is None else varied(ranges),
        "max_steps": task.max_steps,
        "control_hz": task.control_hz,
        "origins": task.origins,
    }


def commanded_columns(task: Task) -> dict[str, list[int]] | None:
    """Returns the columns of action, observation (``"commands"``) and state that belong to each command.

    None if the observation does not repeat the command, or if it is not known what the command moves.
    """
    if task.command is None or not task.moves:
        return None
    columns = {"states": list(task.moves.values()), **_commands_of(task, tuple(task.moves))}
    return columns if len(columns["commands"]) == len(task.moves) else None


def decoded_commands(task: Task) -> dict[str, list[int]] | None:
    """Returns action and observation (``"commands"``) columns of the commands that controllers decode, or None."""
    return _commands_of(task, task.delta_actions) if task.defaults.commands else None


def _commands_of(task: Task, actions: Sequence[int]) -> dict[str, list[int]]:
    """Returns action columns, and the observation columns that repeat their commands."""
    commands = range(task.observation_dim)[task.command_columns][: len(actions)]
    return {"commands": list(commands), "actions": list(actions)}


def tells_commands(task: Task, method: Method) -> bool:
    """Returns whether labels include the commands that actions change; not for ``fit`` methods, which read changes."""
    return task.defaults.commands and method.fit is None


def with_commands(task: Task, data: TensorDictBase) -> TensorDictBase:
    """Replaces changes of commands in flat data ``[N]`` by the new commands, if controllers decode these.

    The last command is that of the label (``label_command``) if there is one, else of the observation. A labelled
    step whose command is not known loses its label.
    """
    decoded = decoded_commands(task)
    if decoded is None:
        return data
    actions = decoded["actions"]
    in_label = LABEL_COMMAND in data.keys()
    last = data[LABEL_COMMAND][:, : len(actions)] if in_label else data[OBSERVATION][:, decoded["commands"]]
    commands = data[ACTION].clone()
    commands[:, actions] += last.to(commands.dtype)
    known = data[HAS_ACTION] & ~commands.isnan().any(-1, keepdim=True)
    return data.copy().set(ACTION, commands).set(HAS_ACTION, known)


def state_reader(task: Task, section: ControllerConfig) -> StateReader:
    """Makes the reader of states for a controller: its columns, and relative positions if they are asked for."""
    pairs = task.relative_columns() if section.columns == "related" else ()
    return StateReader(task.controller_columns(section.columns), RelativePositionFeatures(pairs) if pairs else None)


def controller_data(task: Task, section: ControllerConfig, data: TensorDictBase) -> TensorDictBase:
    """Converts flat data ``[N]`` of :func:`with_commands` to the states and actions (as distances) of a controller."""
    state, view = data[STATE], data.copy()
    if task.distances:
        view.set(ACTION, shift_actions(data[ACTION], state, task.distances, -1))
    return view.set(STATE, state_reader(task, section)(state))


def command_ranges(task: Task, data: TensorDictBase) -> list[list[float] | None]:
    """Returns the least and greatest demonstrated number of every action column.

    Few labels show few directions. So changes of commands in one unit get the range of the largest of them, on every
    axis and in both directions. The range of a target includes the demonstrated values of its state column.

    The data are flat ``[N]`` after the label budget was applied. Both ends are equal if two labels or more repeat one
    number. None stands for a gripper, and for a single label.
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
    repeated = constant_columns(labelled.cpu().numpy())
    return [
        [number, number] if number is not None and meaning.kind != "gripper" else ends
        for meaning, number, ends in zip(meanings, repeated, varied(ranges), strict=True)
    ]


def varied(ranges: Sequence[Sequence[float] | None]) -> list[list[float] | None]:
    """Returns ranges of :func:`command_ranges`, None if both ends are equal."""
    return [None if ends is None or ends[0] == ends[1] else list(ends) for ends in ranges]


def constant_actions(task: Task, ranges: Sequence[Sequence[float] | None]) -> dict[int, float]:
    """Returns the numbers that all labels repeat, by action column: policies command them, whatever is decoded.

    Decoded commands are left out: their labels are changes.
    """
    decoded = decoded_commands(task) or {"actions": []}
    return {
        column: ends[0]
        for column, ends in enumerate(ranges)
        if ends is not None and ends[0] == ends[1] and column not in decoded["actions"]
    }
