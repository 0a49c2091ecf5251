# This source code is licensed under the MIT license found in the LICENSE file.
"""Fitting the commands that belong to a state on the labelled steps, and on no others."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.keys import HAS_ACTION, OBSERVATION, STATE
from torchrl_koap.modules import CommandPosture
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.relative_positions import RelativePosition, RelativePositionFeatures

LABEL_COMMAND = "label_command"  # commands in force at labelled steps [N, J], NaN elsewhere
POSTURE_SHARE = 16  # updates of a posture for each of the controller's, up to UPDATES
UPDATES, BATCH, RATE, WEIGHT_DECAY = 8000, 512, 2e-3, 1e-4


def posture_columns(task: Task) -> dict[str, Any]:
    """What a :class:`~torchrl_koap.modules.CommandPosture` of a task is built with (:func:`build_posture`).

    The number of a gripper is read off planned widths where the task says so (``Task.gripper``), and where an absolute
    action ``name`` has its width in the state, as the part ``name_width``.

    Args:
        task (Task): the task.

    Raises:
        ValueError: if its observation does not repeat the last command, or no action is a change of it.

    Examples:
        >>> from torchrl_koap.tasks import get_task
        >>> from torchrl_koap.training.posture import posture_columns
        >>> posture_columns(get_task("stacking_unobserved_joints"))["commands"]
        [0, 1, 2, 3, 4, 5, 6]
    """
    if task.command is None:
        raise ValueError(
            f"task {task.name!r} cannot keep a posture: its observation has no part that repeats the last command"
            " (Task.command)"
        )
    actions = list(task.delta_actions)
    if not actions:
        raise ValueError(f"task {task.name!r} needs no posture: its actions are commands, not changes of them")
    commands = list(range(task.observation_dim))[task.command_columns]
    relative = [[_ends(part) for part in (*pair, None, None)[:4]] for pair in task.relative_columns()]
    return {
        "state_dim": task.state_dim,
        "commands": [commands[i] for i in actions],
        "actions": actions,
        "gripper": _gripper(task),
        "relative": relative,
    }


def _gripper(task: Task) -> list[int] | None:
    if task.gripper is not None:
        return list(task.gripper)
    widths = [(i, task.state_slices.get(f"{name}_width")) for i, name in enumerate(task.actions)]
    return next(([i, part.start] for i, part in widths if part is not None), None)


def build_posture(columns: dict[str, Any]) -> CommandPosture:
    """The module that :func:`posture_columns` describes.

    Args:
        columns (dict): as there, or as a run's ``config.json`` has it.
    """
    own = dict(columns)
    pairs = [[None if part is None else slice(*part) for part in pair] for pair in own.pop("relative", ())]
    features = RelativePositionFeatures([RelativePosition(*pair) for pair in pairs]) if pairs else None
    return CommandPosture(**own, features=features)


def _ends(part: slice | None) -> list[int] | None:
    return None if part is None else [part.start, part.stop]


def with_label_commands(labelled: TensorDictBase, data: TensorDictBase, command: slice) -> TensorDictBase:
    """Adds the commands in force at labelled steps, which the budget has blanked where other steps are not labelled.

    A recording holds commands, and an action is the difference of two of them: whoever labels a step knows both. What
    is added is what labelled steps have, one command each; of the steps between nothing but the sum of their actions
    could be told from it.

    Args:
        labelled (TensorDictBase): flat data ``[N]`` after the label budget was applied.
        data (TensorDictBase): the same before.
        command (slice): columns of the observation that repeat the command.

    Returns:
        TensorDictBase: a shallow copy with :data:`LABEL_COMMAND` ``[N, J]``, NaN at steps without label.
    """
    known = data[OBSERVATION][:, command].to(labelled[OBSERVATION].device)
    return labelled.copy().set(LABEL_COMMAND, torch.where(labelled[HAS_ACTION], known, torch.nan))


def fit_posture(posture: CommandPosture, data: TensorDictBase, *, updates: int = UPDATES) -> dict[str, Any]:
    """Regresses the commands in force at labelled steps on the state.

    Args:
        posture (CommandPosture): the module, which is trained in place.
        data (TensorDictBase): flat data ``[N]`` after the label budget was applied, with the whole ``state``. Commands
            are those of :data:`LABEL_COMMAND` where it is there (:func:`with_label_commands`), else those of the
            observation, which the budget leaves in trajectories that are labelled throughout.

    Keyword Args:
        updates (int): of 512 steps each. Defaults to ``8000``.

    Returns:
        dict: ``labels_used``; ``commands_told``, how many of them told a command that the budget blanks because it is
        the sum of actions some of which are hidden; and ``fit_error``: root mean square over the labels used, in the
        unit of the commands.

    Raises:
        ValueError: if no labelled step has a known command.
    """
    states, commands, told = _labelled(data, posture)
    if not len(states):
        raise ValueError("keeping a posture needs labelled steps whose command is known, there are none")
    posture.set_scales(states, commands)
    wanted = posture.outputs(commands)
    optimizer = torch.optim.AdamW(posture.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, updates)
    with progress_bar(updates, "posture", smoothing=0.05, mininterval=0.5) as bar, torch.enable_grad():
        for _ in range(updates):
            rows = torch.randint(len(states), (BATCH,), device=states.device)
            loss = (posture.scaled(states[rows]) - wanted[rows]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            bar.update(1)
    with torch.no_grad():
        errors = [posture(x) - c for x, c in zip(states.split(8192), commands.split(8192), strict=True)]
    error = torch.cat(errors).square().mean().sqrt().item()
    return {"labels_used": len(states), "commands_told": told, "fit_error": float(f"{error:.4g}")}


def _labelled(data: TensorDictBase, posture: CommandPosture) -> tuple[Tensor, Tensor, int]:
    """States ``[n, d]`` and commands ``[n, J]`` of labelled steps whose command is known, and how many were told."""
    seen = data[OBSERVATION][:, posture.commands]
    commands = data[LABEL_COMMAND][:, posture.actions] if LABEL_COMMAND in data.keys() else seen
    states = data[STATE].float()
    rows = data[HAS_ACTION].reshape(-1) & ~commands.isnan().any(-1) & ~states.isnan().any(-1)
    return states[rows], commands[rows].float(), int(seen[rows].isnan().any(-1).sum())
