# This source code is licensed under the MIT license found in the LICENSE file.
"""What :func:`~torchrl_koap.modules.make_policy` is told of a task."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl_koap.tasks import Task
from torchrl_koap.tasks.action_rules import ActionRule


def policy_facts(
    task: Task, *, columns: Sequence[int] | None = None, gripper: Sequence[int] | None = None
) -> dict[str, Any]:
    """The facts of a task as keyword arguments of :func:`~torchrl_koap.modules.make_policy`.

    Args:
        task (Task): the task.

    Keyword Args:
        columns (sequence of int, optional): columns of the state that the controller reads. Default: all.
        gripper (sequence of int, optional): action column of a gripper and state column of its width, whose number is
            read off the planned widths, where the task has no rule for actions of its own.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.training.policy_facts import policy_facts
        >>> facts = policy_facts(get_task("avoiding"))
        >>> facts["changes"], facts["commanded"]["commands"], facts["max_steps"]
        ((0, 1), [0, 1], 250)
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
        "max_steps": task.max_steps,
    }


def commanded_columns(task: Task) -> dict[str, list[int]] | None:
    """The columns that actions are about: what they change or set, where it is observed, what it moves.

    Args:
        task (Task): the task.

    Returns:
        dict: columns of the action (``"actions"``), of the observation (``"commands"``) and of the state (``"states"``)
        for every command; None where the observation does not repeat it, or it is not known what it moves.
    """
    actions = list(range(task.action_dim) if task.targets else task.delta_actions)
    moved = list(task.targets or task.moved_columns(or_robot=True))
    if task.command is None:
        return None
    commands = list(range(task.observation_dim))[task.command_columns][: len(actions)]
    if not len(actions) == len(moved) == len(commands):
        return None
    return {"states": moved, "commands": commands, "actions": actions}
