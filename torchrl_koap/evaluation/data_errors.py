# This source code is licensed under the MIT license found in the LICENSE file.
"""Errors of plans and actions on recorded data; no environment is needed.

Several futures may be right: a plan that differs from the demonstration need not be wrong. Plans are scored as a
distribution.

Labels outside the budget are read here, for evaluation only, after the training. The result says how many.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_koap.data import cut_windows
from torchrl_koap.data.trajectories import labelled_episodes
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.evaluation.rollouts import device_of
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, STATE
from torchrl_koap.modules import DiffusionPolicy, LinearInverseDynamics, StatePlanner
from torchrl_koap.modules.planning.energy_score import energy_score, relative_score, sample_sequences
from torchrl_koap.modules.ridge import DEFAULT_PENALTY, ridge
from torchrl_koap.runs.progress import progress_bar
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.action_rules import shift_actions
from torchrl_koap.tasks.columns import unit_groups
from torchrl_koap.training.closed_form import UnusableLabelsError, action_facts, fit_closed_form
from torchrl_koap.training.controller import FEW_VALUES

SAMPLES = 16  # plans per situation
SITUATIONS = 500  # scored at most
# frames around a decoded action: enough history and look-ahead for every controller compared
BEFORE, AFTER = 8, 11
_MOST_LABELS = 20_000  # more of them hardly change the errors
_ENTRIES = (STATE, ACTION, EPISODE)
_BATCH = 2048  # windows that are decoded at once
_MOST_FOLDS = 10  # labelled trajectories that are left out in turn; each takes as long as fitting the decoder


def baseline_plans(history: Tensor, horizon: int) -> dict[str, Tensor]:
    """Makes the plans ``[*B, H, d]`` that a planner has to beat from two or more observed states ``[*B, h, d]``."""
    now, before = history[..., -1:, :], history[..., -2:-1, :]
    ahead = torch.arange(1, horizon + 1, device=history.device, dtype=history.dtype)[:, None]
    return {
        "standing_still": now.expand(*now.shape[:-2], horizon, -1),
        "constant_velocity": now + ahead * (now - before),
    }


def plan_errors(planner: StatePlanner, data: TensorDictBase, task: Task, *, seed: int = 0) -> dict[str, Any]:
    """Scores a planner on held-out trajectories and compares it with standing still and constant velocity.

    Samples :data:`SAMPLES` plans in each of at most :data:`SITUATIONS` situations. These are spread evenly over all
    steps whose whole future is recorded.

    Returns:
        dict: ``situations``, ``horizon``, ``samples``; ``unit``: a row per unit of the state columns, with their names
        (``columns``) and, per model, ``energy_score`` and ``best_of``, each ``overall`` and ``per_step``, from
        distances in that unit over all its columns; ``relative``: the energy score as a share of that of standing
        still, mean over units; ``trajectory``: the relative score per trajectory.
    """
    horizon, history = planner.horizon, max(planner.history, 2)  # constant velocity needs two frames
    keys = [STATE, EPISODE]
    windows = cut_windows(data, history + horizon, select=keys, pad_before=history - 1, most=SITUATIONS)
    states = windows[STATE].float().cpu()
    past, future = planner.split_window(states[:, history - planner.history :])
    episode = windows[EPISODE][:, -1].cpu()
    models = {"planner": sample_sequences(planner, past.to(device_of(planner)), samples=SAMPLES, seed=seed).cpu()}
    models |= {name: plan[None] for name, plan in baseline_plans(states[:, :history], horizon).items()}
    groups = unit_groups(task.state_units)

    def relative(where: Tensor) -> float | None:
        parts = models["planner"][:, where], future[where], models["standing_still"][0, where]
        score = relative_score(*parts, list(groups.values()))
        return None if math.isnan(score) else score

    return {
        "situations": len(past),
        "horizon": horizon,
        "samples": SAMPLES,
        "relative": relative(torch.ones_like(episode, dtype=torch.bool)),
        "unit": [
            {"unit": unit, "columns": [task.state_names[column] for column in columns]}
            | {name: _score(sampled[..., columns], future[..., columns]) for name, sampled in models.items()}
            for unit, columns in groups.items()
        ],
        "trajectory": [
            {"episode": number, "relative_plan_error": relative(episode == number)}
            for number in episode.unique().tolist()
        ],
    }


def _score(sampled: Tensor, true: Tensor) -> dict[str, dict[str, Any]]:
    """Scores plans ``[S, N, H, d]`` by energy score and best sample, overall and per step."""
    score = energy_score(sampled, true)  # [N, H]
    distance = (sampled - true).norm(dim=-1)  # [S, N, H]
    best, per_step = distance.mean(-1).amin(0).mean(), distance.amin(0).mean(0)
    return {
        "energy_score": {"overall": score.mean().item(), "per_step": score.mean(0).tolist()},
        "best_of": {"overall": best.item(), "per_step": per_step.tolist()},
    }


def episodes_outside(data: TensorDictBase, labelled: TensorDictBase) -> Tensor:
    """Returns the numbers of the trajectories without a label in the budget."""
    every = data[EPISODE].unique()
    return every[~torch.isin(every, labelled_episodes(labelled).to(every.device))]


@torch.no_grad()
def first_actions(
    controller: nn.Module, data: TensorDictBase, episodes: Tensor | Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Decodes actions on at most 20,000 labelled steps of ``episodes``, the same steps for every controller.

    Returns predicted and true actions ``[N, act]`` in raw units, and the trajectory of every step ``[N]``.
    """
    wanted = torch.isin(data[EPISODE], torch.as_tensor(episodes, device=data[EPISODE].device))
    numbers, lengths = data[EPISODE][wanted].unique(return_counts=True)
    part = data[torch.isin(data[EPISODE], numbers[lengths > AFTER])]
    if not len(part):
        return data[ACTION][:0].cpu(), data[ACTION][:0].cpu(), data[EPISODE][:0].cpu()
    windows = cut_windows(
        part, BEFORE + 1 + AFTER, select=_ENTRIES, pad_before=BEFORE, labelled_frame=BEFORE, most=_MOST_LABELS
    )
    past, predicted = min(controller.num_past, BEFORE), []
    for rows in windows[STATE][:, BEFORE - past :].split(_BATCH):
        states = TensorDict({controller.in_keys[0]: rows.to(device_of(controller))}, [len(rows)])
        predicted.append(controller(states)[controller.out_keys[-1]][:, past].cpu())
    return torch.cat(predicted), windows[ACTION][:, BEFORE].cpu(), windows[EPISODE][:, -1].cpu()


def errors_outside_budget(
    controller: nn.Module, data: TensorDictBase, labelled: TensorDictBase, task: Task, repeated: Sequence[int] = ()
) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Measures errors on the trajectories whose labels are all outside the budget.

    The flat ``data``, as the controller sees them, have all labels, ``labelled`` those of the budget. A policy
    commands ``repeated`` action columns as all labels have them. Returns the result of :func:`summarise_errors`, or a
    ``note`` why there is none, and actions ``predicted`` and ``true`` ``[N, act]``.
    """
    outside = episodes_outside(data, labelled)
    predicted, true, episode = first_actions(controller, data, outside)
    if not len(true):
        return {"note": "no trajectory outside the budget has labels"}, {}
    try:
        models = _with_baselines(predicted, true, labelled, data, outside, repeated)
    except UnusableLabelsError as error:
        return {"note": f"the ridge on raw frames cannot be fitted: {error}"}, {}
    return summarise_errors(models, true, episode, task), {"predicted": models["controller"], "true": true}


def _with_baselines(
    predicted: Tensor,
    true: Tensor,
    known: TensorDictBase,
    data: TensorDictBase,
    episodes: Tensor | Sequence[int],
    repeated: Sequence[int],
) -> dict[str, Tensor]:
    """Returns actions ``[N, act]`` of a controller, of a ridge on raw frames, and the mean of the known actions."""
    linear = LinearInverseDynamics(known[STATE].shape[-1], true.shape[-1]).to(known[STATE].dtype)
    fit_closed_form(linear, known)
    exact = torch.isin(torch.arange(true.shape[-1]), torch.tensor(repeated, dtype=torch.long))
    return {
        "controller": torch.where(exact, true, predicted),
        "ridge": first_actions(linear, data, episodes)[0],
        "mean_action": known[ACTION][known[HAS_ACTION].squeeze(-1)].mean(0).expand_as(true),
    }


def errors_left_out(
    controller: nn.Module, labelled: TensorDictBase, task: Task, columns: Sequence[int], repeated: Sequence[int] = ()
) -> dict[str, Any]:
    """Measures errors on labels in the budget: hides each labelled trajectory in turn and refits the decoder.

    Only the decoder of a copy is fitted again; the rest was trained with the states of the trajectory left out. The
    controller reads the state ``columns``. Other arguments and the result are those of :func:`errors_outside_budget`.
    """
    episodes = labelled_episodes(labelled)
    if len(episodes) < 2:
        return {"note": "only one trajectory has labels: none can be left out"}
    chosen, folds = spread_evenly(episodes, _MOST_FOLDS).tolist(), []
    with progress_bar(len(chosen), "leave one out", unit="trajectory") as bar:
        for number in chosen:
            fold = labelled.copy()
            hidden = labelled[EPISODE] == number
            fold[HAS_ACTION] = labelled[HAS_ACTION] & ~hidden.unsqueeze(-1)
            fold[ACTION] = torch.where(fold[HAS_ACTION], labelled[ACTION], math.nan)
            again = copy.deepcopy(controller)
            with suppress(UnusableLabelsError):  # of the other trajectories
                fit_closed_form(again, fold, **action_facts(task, columns))
                predicted, true, episode = first_actions(again, labelled, [number])
                if len(true):  # otherwise its labels lie too near its end
                    folds.append((_with_baselines(predicted, true, fold, labelled, [number], repeated), true, episode))
            bar.update()
    if not folds:
        return {"note": "no labelled step has enough recorded future to decode its action"}
    models, truths, numbers = zip(*folds, strict=True)
    joined = {name: torch.cat([part[name] for part in models]) for name in models[0]}
    return summarise_errors(joined, torch.cat(truths), torch.cat(numbers), task)


def errors_of_chunks(
    policy: DiffusionPolicy, data: TensorDictBase, labelled: TensorDictBase, task: Task, *, seed: int = 0
) -> dict[str, Any]:
    """Measures errors of sampled actions on the trajectories whose labels are all outside the budget.

    Evaluates the mean of the first actions of :data:`SAMPLES` chunks in at most :data:`SITUATIONS` situations. The
    ridge is a linear policy that reads the same frames. Arguments, with all state columns, and result are those of
    :func:`errors_outside_budget`.
    """
    history, targets = policy.history, tuple(task.targets.items())
    episodes = episodes_outside(data, labelled)
    now = history - 1
    options: dict[str, Any] = {"select": _ENTRIES, "pad_before": now, "labelled_frame": now}
    outside = data[torch.isin(data[EPISODE], episodes)]
    windows = cut_windows(outside, now + policy.horizon, most=SITUATIONS, **options).cpu()
    if not len(windows):
        return {"note": "no trajectory outside the budget has labels"}
    known = cut_windows(labelled, history + 1, **options).cpu()

    def moved(action: Tensor, states: Tensor) -> Tensor:
        """Returns absolute actions relative to their state columns in the present frame."""
        return shift_actions(action, states[:, now], targets, sign=-1)

    past, device = windows[STATE][:, :history].float(), device_of(policy)
    true, seen = (moved(part[ACTION][:, now], part[STATE]) for part in (windows, known))
    sampled = sample_sequences(policy, past.to(device), samples=SAMPLES, seed=seed)[:, :, 0].mean(0).cpu()
    condition, asked = (
        policy.encode_history(frames.float().to(device)).cpu() for frames in (known[STATE][:, :history], past)
    )
    linear = ridge(condition, seen, groups=known[EPISODE][:, -1], default_penalty=DEFAULT_PENALTY)
    models = {
        "controller": moved(sampled, past),
        "ridge": linear.predict(asked),
        "mean_action": seen.mean(0).expand(len(true), -1),
    }
    return summarise_errors(models, true, windows[EPISODE][:, -1], task)


def summarise_errors(models: dict[str, Tensor], true: Tensor, episode: Tensor, task: Task) -> dict[str, Any]:
    """Computes root mean squared errors of predicted actions ``[N, act]``; ``episode [N]`` are their trajectories.

    Returns:
        dict: ``labels``, ``trajectories``; ``relative``: the controller's error as a share of that of the mean action,
        root mean square over columns (1: no better than always giving the mean action); ``ridge_relative``: the
        ridge's likewise; ``unit`` and ``column``: rows with the errors of every model in the unit of the data, with
        raw actions without a unit in a row of their own; ``trajectory``: the relative error of each. Raw columns with
        few values have ``values``: how many ``labels`` have each, and for how many the prediction is ``nearest`` to it.
    """
    square = {name: (predicted - true).square() for name, predicted in models.items()}
    units, names = list(task.action_units), task.action_names
    raw = [action.kind == "raw" for action in task.actions.values()]
    own_unit = [unit or ("raw" if of_none else "") for unit, of_none in zip(units, raw, strict=True)]

    def values(column: int) -> dict[str, Any]:
        levels, which = true[:, column].unique(return_inverse=True)
        if not raw[column] or not 1 < len(levels) <= FEW_VALUES:
            return {}
        near = (models["controller"][:, column, None] - levels).abs().argmin(-1) == which
        counted = [(value.item(), which == place) for place, value in enumerate(levels)]
        return {"values": [{"value": v, "labels": int(at.sum()), "nearest": int(near[at].sum())} for v, at in counted]}

    def root(columns: Sequence[int]) -> dict[str, float]:
        return {name: part[:, columns].mean().sqrt().item() for name, part in square.items()}

    return {
        "labels": len(true),
        "trajectories": len(episode.unique()),
        "relative": _relative(square),
        "ridge_relative": _relative(square, "ridge"),
        "unit": [
            {"unit": units[columns[0]], "columns": [names[column] for column in columns], **root(columns)}
            for columns in unit_groups(own_unit).values()
        ],
        "column": [
            {"name": name, "unit": units[column], **root([column]), **values(column)}
            for column, name in enumerate(names)
        ],
        "trajectory": [
            {"episode": int(number), "relative_action_error": _relative(square, where=episode == number)}
            for number in episode.unique()
        ],
    }


def _relative(square: dict[str, Tensor], name: str = "controller", where: Tensor | None = None) -> float | None:
    """Returns an error relative to that of the mean action over all steps, so that trajectories can be compared."""
    scale = square["mean_action"].mean(0)
    own = (square[name] if where is None else square[name][where]).mean(0)
    moves = scale > 0
    return (own[moves] / scale[moves]).mean().sqrt().item() if moves.any() else None
