# This source code is licensed under the MIT license found in the LICENSE file.
"""How far decoded actions lie from recorded ones, beside a controller that always gives the mean action."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_koap.modules import LinearInverseDynamics
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.units import unit_groups
from torchrl_koap.training.action_errors import episodes_outside, first_actions
from torchrl_koap.training.closed_form import fit_closed_form

_MOST_FOLDS = 20  # labelled trajectories that are left out in turn, at most


def errors_outside_budget(
    controller: nn.Module, data: TensorDictBase, labelled: TensorDictBase, task: Task
) -> dict[str, Any]:
    """Errors on the trajectories that have labels of which none was in the budget; an analysis, nothing selects by it.

    Args:
        controller (nn.Module): the trained controller.
        data (TensorDictBase): flat, as the controller sees it, with all labels that there are.
        labelled (TensorDictBase): the same after the budget was applied.
        task (Task): names and units of the actions.

    Returns:
        dict: of :func:`summarise_errors`, or a ``note`` why there is none.
    """
    predicted, true, episode = first_actions(controller, data, episodes_outside(data, labelled))
    if not len(true):
        return {"note": "no trajectory outside the budget has labels"}
    known = labelled["action"][labelled["has_action"].squeeze(-1)]
    ridge = LinearInverseDynamics(data["state"].shape[-1], task.action_dim).to(data["state"].dtype)
    fit_closed_form(ridge, labelled)
    models = {
        "controller": predicted,
        "ridge": first_actions(ridge, data, episodes_outside(data, labelled))[0],
        "mean_action": known.mean(0).expand_as(true),
    }
    return summarise_errors(models, true, episode, task)


def errors_left_out(
    controller: nn.Module,
    labelled: TensorDictBase,
    task: Task,
    *,
    closed_form: bool,
    guessed_axes: Sequence[int] = (),
) -> dict[str, Any]:
    """Errors on labels inside the budget: each labelled trajectory in turn is hidden and the decoder is fitted again.

    What lies before the decoder stays as it was trained; it has seen the states of the trajectory left out, and none of
    its labels where it is trained without any.

    Args:
        controller (nn.Module): the trained controller; not changed.
        labelled (TensorDictBase): flat data after the budget was applied, as the controller sees it.
        task (Task): names and units of the actions.

    Keyword Args:
        closed_form (bool): the controller's decoder is fitted in closed form. Otherwise it would have to be trained
            again for each trajectory, and there is only a note.
        guessed_axes (sequence of int): as in training (:func:`~torchrl_koap.training.closed_form.likely_axes`).

    Returns:
        dict: of :func:`summarise_errors`, or a ``note`` why there is none.
    """
    if not closed_form:
        return {"note": "the decoder is not fitted in closed form: leaving a trajectory out would mean to train again"}
    has_action = labelled["has_action"].squeeze(-1)
    episodes = labelled["episode"][has_action].unique()
    if len(episodes) < 2:
        return {"note": "only one trajectory has labels: none can be left out"}
    left_out = episodes[torch.linspace(0, len(episodes) - 1, min(len(episodes), _MOST_FOLDS)).round().long()]
    models: dict[str, list[Tensor]] = {"controller": [], "ridge": [], "mean_action": []}
    truths, places = [], []
    for number in left_out:
        fold = labelled.copy()
        hidden = labelled["episode"] == number
        fold["has_action"] = labelled["has_action"] & ~hidden.unsqueeze(-1)
        fold["action"] = torch.where(fold["has_action"], labelled["action"], math.nan)
        again = copy.deepcopy(controller)
        fit_closed_form(again, fold, shared_axes=task.moved_columns(), guessed_axes=guessed_axes)
        ridge = LinearInverseDynamics(labelled["state"].shape[-1], task.action_dim).to(labelled["state"].dtype)
        fit_closed_form(ridge, fold)
        predicted, true, episode = first_actions(again, labelled, [int(number)])
        if not len(true):  # its labels lie too near its end
            continue
        models["controller"].append(predicted)
        models["ridge"].append(first_actions(ridge, labelled, [int(number)])[0])
        models["mean_action"].append(fold["action"][fold["has_action"].squeeze(-1)].mean(0).expand_as(true))
        truths.append(true)
        places.append(episode)
    if not truths:
        return {"note": "no labelled step has enough recorded future to decode its action"}
    joined = {name: torch.cat(parts) for name, parts in models.items()}
    return summarise_errors(joined, torch.cat(truths), torch.cat(places), task)


def summarise_errors(models: dict[str, Tensor], true: Tensor, episode: Tensor, task: Task) -> dict[str, Any]:
    """Root mean squared errors by column and by unit, and as shares of those of the mean action.

    Args:
        models (dict): name to predicted actions ``[N, act]``; ``"mean_action"`` is what ``"controller"`` has to beat.
        true (Tensor): recorded actions ``[N, act]``.
        episode (Tensor): trajectory of every step ``[N]``.
        task (Task): names and units of the actions.

    Returns:
        dict: ``labels``, ``trajectories``; ``relative``: the controller's error as a share of that of the mean action,
        root mean square over columns (1: no better than always giving the mean action); ``unit`` and ``column``: rows
        with the errors of every model in the unit of the data; ``trajectory``: the relative error of each.

    Examples:
        >>> import torch
        >>> from torchrl_koap.evaluation.label_errors import summarise_errors
        >>> from torchrl_koap.tasks import get_task
        >>> true = torch.tensor([[1.0, 2.0], [-1.0, -2.0]])
        >>> models = {"controller": true / 2, "mean_action": torch.zeros(2, 2)}
        >>> summarise_errors(models, true, torch.zeros(2), get_task("avoiding"))["relative"]
        0.5
    """
    square = {name: (predicted - true).square() for name, predicted in models.items()}
    units, names = list(task.action_units), task.action_names

    def root(columns: Sequence[int]) -> dict[str, float]:
        return {name: part[:, columns].mean().sqrt().item() for name, part in square.items()}

    return {
        "labels": len(true),
        "trajectories": len(episode.unique()),
        "relative": _relative(square),
        "relative_of_ridge": _relative(square, "ridge") if "ridge" in square else None,
        "unit": [
            {"unit": unit, "columns": [names[column] for column in columns], **root(columns)}
            for unit, columns in unit_groups(units).items()
        ],
        "column": [{"name": names[column], "unit": units[column], **root([column])} for column in range(len(names))],
        "trajectory": [
            {"episode": int(number), "relative_action_error": _relative(square, where=episode == number)}
            for number in episode.unique()
        ],
    }


def _relative(square: dict[str, Tensor], name: str = "controller", where: Tensor | None = None) -> float | None:
    """Error over that of the mean action; the scale is that of all steps, so that trajectories can be compared."""
    scale = square["mean_action"].mean(0)
    own = (square[name] if where is None else square[name][where]).mean(0)
    moves = scale > 0
    return (own[moves] / scale[moves]).mean().sqrt().item() if moves.any() else None
