# This source code is licensed under the MIT license found in the LICENSE file.
"""What a task says of its data to a controller, and of the robot to :func:`~torchrl_koap.modules.make_policy`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase

from torchrl_koap.keys import ACTION, HAS_ACTION, LABEL_COMMAND, OBSERVATION, STATE
from torchrl_koap.modules.planning.denoisers import RelativePositionFeatures
from torchrl_koap.modules.windows import StateReader
from torchrl_koap.runs.config import ControllerConfig
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.action_rules import shift_actions
from torchrl_koap.tasks.columns import unit_groups
from torchrl_koap.training.method import Method


def policy_facts(
    task: Task, *, reads: StateReader | None = None, ranges: Sequence[Sequence[float] | None] | None = None
) -> dict[str, Any]:
    """The facts of a task as keyword arguments of :func:`~torchrl_koap.modules.make_policy`.

    ``reads`` is what the controller reads of states (default: all columns), ``ranges`` are those of
    :func:`command_ranges`.
    """
    return {
        "state_of": task.state_of,
        "reads": reads,
        "action_rule": task.action_rule,
        "changes": tuple(task.delta_actions),
        "commanded": None if task.targets else commanded_columns(task),
        "decoded": decoded_commands(task),
        "ranges": ranges,
        "max_steps": task.max_steps,
        "control_hz": task.control_hz,
        "origins": task.origins,
    }


def commanded_columns(task: Task) -> dict[str, list[int]] | None:
    """The columns of action, observation (``"commands"``) and state that belong to each command.

    None where the observation does not repeat the command, or it is not known what it moves.
    """
    if task.command is None or not task.moves:
        return None
    columns = {"states": list(task.moves.values()), **_commands_of(task, tuple(task.moves))}
    return columns if len(columns["commands"]) == len(task.moves) else None


def decoded_commands(task: Task) -> dict[str, list[int]] | None:
    """The columns of action and observation (``"commands"``) of the commands that controllers decode; None if none."""
    return _commands_of(task, task.delta_actions) if task.defaults.commands else None


def _commands_of(task: Task, actions: Sequence[int]) -> dict[str, list[int]]:
    """Action columns, and the observation columns that repeat their commands."""
    commands = range(task.observation_dim)[task.command_columns][: len(actions)]
    return {"commands": list(commands), "actions": list(actions)}


def tells_commands(task: Task, method: Method) -> bool:
    """Whether labels tell a method the commands that actions change: one that has a fit of its own reads changes."""
    return task.defaults.commands and method.fit is None


def with_commands(task: Task, data: TensorDictBase) -> TensorDictBase:
    """Flat data ``[N]`` whose actions are the commands that they lead to, where controllers decode these.

    The last command is the one that a label tells (``label_command``), or of the observation where none does. A
    labelled step whose command is not known is none.
    """
    decoded = decoded_commands(task)
    if decoded is None:
        return data
    actions = decoded["actions"]
    told = LABEL_COMMAND in data.keys()
    last = data[LABEL_COMMAND][:, : len(actions)] if told else data[OBSERVATION][:, decoded["commands"]]
    commands = data[ACTION].clone()
    commands[:, actions] += last.to(commands.dtype)
    known = data[HAS_ACTION] & ~commands.isnan().any(-1, keepdim=True)
    return data.copy().set(ACTION, commands).set(HAS_ACTION, known)


def state_reader(task: Task, section: ControllerConfig) -> StateReader:
    """Makes what a controller reads of states: its columns, and relative positions where these are asked for."""
    pairs = task.relative_columns() if section.columns == "related" else ()
    return StateReader(task.controller_columns(section.columns), RelativePositionFeatures(pairs) if pairs else None)


def controller_data(task: Task, section: ControllerConfig, data: TensorDictBase) -> TensorDictBase:
    """Flat data ``[N]`` of :func:`with_commands` as a controller sees them: what it reads, and actions as distances."""
    state, view = data[STATE], data.copy()
    if task.distances:
        view.set(ACTION, shift_actions(data[ACTION], state, task.distances, -1))
    return view.set(STATE, state_reader(task, section)(state))


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
