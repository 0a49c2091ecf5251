# This source code is licensed under the MIT license found in the LICENSE file.
"""What is measured about a finished controller with labels outside its budget: for analysis only, and counted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_koap.data import controller_view, cut_windows
from torchrl_koap.modules import InverseDynamics, LinearInverseDynamics
from torchrl_koap.runs.run_directory import RunDirectory
from torchrl_koap.runs.weights import save_tensors
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.units import thousandths
from torchrl_koap.training.closed_form import fit_closed_form

# frames of the evaluation windows: enough history and look-ahead for every controller compared
BEFORE, AFTER = 8, 11
UNITS = {"m": "mm", "rad": "mrad"}  # unit of the actions to the unit of their errors


@torch.no_grad()
def hidden_action_errors(
    controller: nn.Module, data: TensorDictBase, labelled: TensorDictBase
) -> tuple[Tensor, Tensor]:
    """Predicted and true actions on the trajectories of which no label was in the budget.

    The first action decoded from a window of recorded states, ``BEFORE`` frames of history (the first frame of a
    trajectory repeated where there is none) and ``AFTER`` frames of future: the same steps for every controller.

    Args:
        controller (nn.Module): writes actions ``[*B, T, act]`` for windows of states ``[*B, T, d]``.
        data (TensorDictBase): flat, with all labels that there are.
        labelled (TensorDictBase): the same after the budget was applied.

    Returns:
        tuple of Tensor: both ``[N, act]``, raw units; ``N = 0`` if every trajectory has a label.
    """
    return first_actions(controller, data, episodes_outside(data, labelled))[:2]


def episodes_outside(data: TensorDictBase, labelled: TensorDictBase) -> Tensor:
    """Numbers of the trajectories of which no label was in the budget.

    Args:
        data (TensorDictBase): flat, with all labels that there are.
        labelled (TensorDictBase): the same, or a part, after the budget was applied.
    """
    touched = labelled["episode"][labelled["has_action"].squeeze(-1)].unique()
    every = data["episode"].unique()
    return every[~torch.isin(every, touched.to(every.device))]


@torch.no_grad()
def first_actions(
    controller: nn.Module, data: TensorDictBase, episodes: Tensor | Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Predicted and true actions on the labelled steps of some trajectories, see :func:`hidden_action_errors`.

    Args:
        controller (nn.Module): writes actions ``[*B, T, act]`` for windows of states ``[*B, T, d]``.
        data (TensorDictBase): flat, as the controller sees it.
        episodes (Tensor or sequence of int): the trajectories.

    Returns:
        tuple of Tensor: both ``[N, act]``, raw units, and the trajectory of every step ``[N]``.
    """
    windows = cut_windows(data, BEFORE + 1 + AFTER, select=["state", "action", "episode"], pad_before=BEFORE)
    known = windows["action"][:, BEFORE].isfinite().all(-1)  # the data may lack labels themselves
    wanted = torch.as_tensor(episodes, device=windows["episode"].device)
    windows = windows[known & torch.isin(windows["episode"][:, -1], wanted)]
    device = next(iter(controller.state_dict().values())).device
    states = windows["state"][:, BEFORE - min(controller.num_past, BEFORE) :].to(device)
    predicted = controller(TensorDict({"state": states}, batch_size=[len(states)]))["action"]
    return predicted[:, min(controller.num_past, BEFORE)].cpu(), windows["action"][:, BEFORE], windows["episode"][:, -1]


def rmse(predicted: Tensor, true: Tensor, unit: str) -> float:
    """Root of the mean squared error over steps and axes, in the unit that :func:`thousandths` shows ``unit`` in.

    Args:
        predicted (Tensor): ``[N, act]``.
        true (Tensor): ``[N, act]``.
        unit (str): unit of both.
    """
    return (predicted - true).square().mean().sqrt().item() * thousandths(unit)[1]


def error_entry(unit: str) -> str:
    """Name of the entry of ``summary.json`` that holds the errors of actions in ``unit``.

    Examples:
        >>> from torchrl_koap.training.action_errors import error_entry
        >>> error_entry("m"), error_entry("")
        ('action_error_mm', 'action_error')
    """
    return f"action_error_{thousandths(unit)[0]}" if unit else "action_error"


def rmse_mm(predicted: Tensor, true: Tensor) -> float:
    """Root of the mean squared error over steps and axes, in mm (mrad for angles).

    Args:
        predicted (Tensor): actions ``[N, a]`` (m or rad).
        true (Tensor): the actions that were recorded, of the same shape.
    """
    return (predicted - true).square().mean().sqrt().item() * 1e3


def _plotted(task: Task, observation: Tensor) -> dict[str, Tensor]:
    """Positions of the tool ``[N, 2]`` and, where there are any, of the objects ``[N, objects, 2]`` for pictures."""
    starts = [task.observation[part].start for part in (task.position, *(body.position for body in task.bodies))]
    tool, *objects = (observation[:, start : start + 2] for start in starts)
    return {"position": tool.contiguous()} | ({"objects": torch.stack(objects, 1)} if objects else {})


def write_analysis(
    run: RunDirectory,
    task: Task,
    data: TensorDictBase,
    labelled: TensorDictBase,
    controller: nn.Module,
    columns: Sequence[int],
) -> dict[str, Any]:
    """Action error of the controller, and of a ridge on the same raw columns and labels, on hidden trajectories.

    Writes ``actions.safetensors`` and ``demonstrations.safetensors`` for the report.

    Args:
        run (RunDirectory): where to.
        task (Task): the task.
        data (TensorDictBase): flat data ``[N]`` with every label there is; read after training alone.
        labelled (TensorDictBase): the same data with the labels of the budget.
        controller (nn.Module): the controller.
        columns (sequence of int): state columns that it reads.

    Returns:
        dict: ``controller`` and ``ridge``, root mean squared errors in mm or mrad, and ``analysis_labels_read``; a
        ``note`` alone where no hidden trajectory has labels.
    """
    # trajectories that the training does not use have no label
    has_action = torch.zeros(len(data), dtype=torch.bool)
    has_action[torch.isin(data["episode"], labelled["episode"])] = labelled["has_action"].squeeze(-1)
    shown = {"state": data["state"], "episode": data["episode"], "labelled": has_action}
    if task.env is not None:  # otherwise nobody knows what lies in a plane
        shown |= _plotted(task, data["observation"])
    save_tensors(run.path / "demonstrations.safetensors", shown)
    if not isinstance(controller, InverseDynamics):
        return {"note": "the controller decodes no recorded states: it follows plans by the command that it gave"}
    labelled = controller_view(labelled.cpu(), columns, targets=task.targets)
    viewed = controller_view(data, columns, targets=task.targets)
    predicted, true = hidden_action_errors(controller, viewed, labelled)
    if not len(true):
        return {"note": "no trajectory outside the budget has labels: there is nothing to measure on"}
    save_tensors(run.path / "actions.safetensors", {"predicted": predicted, "true": true})
    ridge = LinearInverseDynamics(len(columns), task.action_dim).to(data["state"].dtype)
    fit_closed_form(ridge, labelled)
    same = task.action_columns()
    by_ridge, _ = hidden_action_errors(ridge, viewed, labelled)
    return {
        "controller": rmse(predicted[:, same], true[:, same], task.action_unit),
        "ridge": rmse(by_ridge[:, same], true[:, same], task.action_unit),
        "analysis_labels_read": len(true),
    }
