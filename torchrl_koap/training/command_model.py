# This source code is licensed under the MIT license found in the LICENSE file.
"""Fitting the commands that belong to a state on the labelled steps, and on no others."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.keys import HAS_ACTION, LABEL_COMMAND, OBSERVATION, STATE
from torchrl_koap.modules import CommandDecoder
from torchrl_koap.modules.planning.denoisers import RelativePositionFeatures
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.tasks import Task
from torchrl_koap.training.policy_facts import check_commanded

SHARE = 16  # updates for each of another controller's, up to UPDATES
UPDATES, BATCH, RATE, WEIGHT_DECAY = 8000, 512, 2e-3, 1e-4


def build_decoder(task: Task) -> CommandDecoder:
    """Builds the module that tells a task's commands from its state.

    Raises:
        ValueError: if its observation does not repeat the last command, no action is a change of it, or nothing tells
            the others.
    """
    actions = list(task.delta_actions)
    if task.command is not None and not actions:
        raise ValueError(f"task {task.name!r} needs no commands regressed: its actions are commands, not their changes")
    check_commanded(task, "cannot have its commands regressed", actions, gripper_columns(task))
    repeated = list(range(task.observation_dim))[task.command_columns]
    commands, pairs = [repeated[i] for i in actions], task.relative_columns()
    features = RelativePositionFeatures(pairs) if pairs else None
    return CommandDecoder(task.state_dim, commands, actions, action_dim=task.action_dim, features=features)


def gripper_columns(task: Task) -> list[int] | None:
    """Finds action column and state column of a gripper whose number is read off planned widths.

    These are ``Task.gripper``, or of an absolute action ``name`` whose width is the part ``name_width`` of the state.
    """
    if task.gripper is not None:
        return list(task.gripper)
    widths = [(i, task.state_slices.get(f"{name}_width")) for i, name in enumerate(task.actions)]
    return next(([i, part.start] for i, part in widths if part is not None), None)


def fit_decoder(decoder: CommandDecoder, data: TensorDictBase, *, updates: int = UPDATES) -> dict[str, Any]:
    """Regresses the commands at labelled steps of flat data ``[N]`` on the whole state, in updates of 512 steps each.

    Commands are those that labels tell (``label_command``), or of the observation where none does.

    Returned are ``labels_used`` and ``fit_error``: root mean square over the labels used, in the unit of the commands.

    Raises:
        ValueError: if no labelled step has a known command.
    """
    states, commands = _labelled(data, decoder)
    if not len(states):
        raise ValueError("a regression of commands needs labelled steps whose command is known, there are none")
    decoder.set_scales(states, commands)
    wanted = decoder.outputs(commands)
    optimizer = torch.optim.AdamW(decoder.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, updates)
    with progress_bar(updates, "commands", smoothing=0.05, mininterval=0.5) as bar, torch.enable_grad():
        for _ in range(updates):
            rows = torch.randint(len(states), (BATCH,), device=states.device)
            loss = (decoder.scaled(states[rows]) - wanted[rows]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            bar.update(1)
    with torch.no_grad():
        errors = [decoder(x) - c for x, c in zip(states.split(8192), commands.split(8192), strict=True)]
    error = torch.cat(errors).square().mean().sqrt().item()
    return {"labels_used": len(states), "fit_error": float(f"{error:.4g}")}


def _labelled(data: TensorDictBase, decoder: CommandDecoder) -> tuple[Tensor, Tensor]:
    """States ``[n, d]`` and commands ``[n, J]`` of labelled steps whose command is known."""
    if LABEL_COMMAND in data.keys():
        commands = data[LABEL_COMMAND][:, decoder.actions]
    else:
        commands = data[OBSERVATION][:, decoder.commands]
    states = data[STATE].float()
    rows = data[HAS_ACTION].reshape(-1) & ~commands.isnan().any(-1) & ~states.isnan().any(-1)
    return states[rows], commands[rows].float()
