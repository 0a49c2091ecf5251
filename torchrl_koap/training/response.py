# This source code is licensed under the MIT license found in the LICENSE file.
"""Fits the response of a robot to its commands, on labelled steps only.

A ridge regression of single steps comes first, then nonlinear least squares of predictions over several steps.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorClass, TensorDictBase
from torch import Tensor

from torchrl_koap.data.trajectories import begins
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, OBSERVATION, STATE
from torchrl_koap.modules import ResponseModel
from torchrl_koap.tasks import Task
from torchrl_koap.training.policy_facts import commanded_columns

AHEAD = 12  # control steps that are predicted, in the fit and in cross-validation
PENALTY = 1e-5  # relative; larger ones shrink momentum, and the robot cannot follow plans
MOST = 4000  # stretches that are predicted at most, evenly spaced
STAY = 1e-3  # weight of changes of the coefficients (unit: mean step per mean coordinate) against relative errors
_ITERATIONS = 30
_FOLDS = 5
_USELESS = 10  # times the error of standing still; short noisy stretches give up to 2
_LEAST = 9  # fewest steps per fold when folds are blocks of a few stretches


def tracked_columns(task: Task) -> dict[str, Any]:
    """Returns the arguments of a :class:`~torchrl_koap.modules.ResponseModel`: which columns a task's actions move.

    Raises:
        ValueError: if its observation does not repeat the last command, or it is not known what the actions move.
    """
    columns = commanded_columns(task)
    if columns is not None:
        known = (*columns["actions"], *(task.gripper or ())[:1])
        rest = [name for column, name in enumerate(task.action_names) if column not in known]
        if not rest:
            return columns | {"absolute": bool(task.targets)}
        lacks = f"it is not known what the actions {', '.join(rest)} move"
    elif task.command is None:
        lacks = "its observation has no part that repeats the last command (Task.command)"
    else:
        lacks = (
            f"its {task.action_dim} actions, the commands ({task.command!r}) and the state columns that they move"
            " (Action.column or Task.robot) differ in number"
        )
    raise ValueError(f"task {task.name!r} cannot follow plans by prediction: {lacks}")


class LabelledSteps(TensorClass):
    """Labelled steps, in the order of time."""

    coordinates: Tensor  # inputs of the model [n, J, f]
    steps: Tensor  # change of position in the next control step [n, J]
    segment: Tensor  # number of its unbroken stretch [n]
    known: Tensor  # whether the command itself is known, or only its changes [n]
    row: Tensor  # its row in the data [n]


class Stretches(TensorClass):
    """Stretches of labelled steps of equal length ``N``, whose measured positions are predicted."""

    positions: Tensor  # measured before the stretch [n, memory + 1, J], the present one last
    command: Tensor  # the last command [n, J]
    changes: Tensor  # changes that led to it [n, memory, J]
    future: Tensor  # future changes of the command [n, N, J]
    measured: Tensor  # future positions [n, N, J]
    known: Tensor  # whether the command itself is known, not only up to a constant [n]


def fit_response(response: ResponseModel, data: TensorDictBase) -> dict[str, Any]:
    """Fits a response to labelled steps of flat data ``[N]``; couples axes if cross-validation favours it.

    The fit of predictions over up to 12 steps (:func:`fit_predictions`) starts from a ridge regression of single steps.

    If only parts of a trajectory have labels, its commands are hidden and only their changes are known: every such
    stretch then has an unknown offset, which is eliminated (fixed effects).

    Returns ``coupled``, ``labels_used`` and ``held_out_error``: the root mean square error of predictions over up to 12
    steps, in the unit of the axes; None if there were too few steps for cross-validation.

    Raises:
        ValueError: if no stretch of labelled steps is long enough, or predictions are ten times worse than standing
            still.
    """
    steps, changes = labelled_steps(response, data)
    if not len(steps.row):
        raise ValueError(
            f"following plans by prediction needs at least {response.memory} labelled steps in a row, there are none"
        )
    folds, found = _folds(steps), dict[bool, float]()
    for coupled in (False, True) if folds is not None else ():
        errors = []
        for fold in range(_FOLDS):
            out = folds == fold
            _fit(response, data, steps[~out], changes, coupled=coupled)
            errors.append(prediction_errors(response, _stretches(response, data, steps[out], changes)).flatten())
        found[coupled] = torch.cat(errors).pow(2).mean().sqrt().item()
    coupled = min(found, key=found.__getitem__, default=False)
    _fit(response, data, steps, changes, coupled=coupled)
    whole = _stretches(response, data, steps, changes)
    still = (whole.measured - whole.positions[:, -1:]).square().mean().sqrt().item()
    if found and not found[coupled] <= _USELESS * still:
        raise ValueError(
            f"predicted positions have an error of {found[coupled]:.3g}, standing still one of {still:.3g}: the robot"
            " does not follow its commands, or follows them without any lag; use another method"
        )
    return {
        "coupled": coupled,
        "labels_used": len(steps.row),
        "held_out_error": float(f"{found[coupled]:.4g}") if found else None,
    }


def _around(values: Tensor, row: Tensor, first: int, last: int) -> Tensor:
    """Returns ``values [N, ...]`` from ``first`` to ``last`` steps after rows ``[n]``, both included."""
    return values[row.unsqueeze(-1) + torch.arange(first, last + 1, device=row.device)]


def labelled_steps(response: ResponseModel, data: TensorDictBase) -> tuple[LabelledSteps, Tensor]:
    """Returns the steps for the fit, and the changes of the command ``[N, J]``, NaN where they are not known."""
    memory, axes = response.memory, response.num_axes
    episode, labelled = data[EPISODE], data[HAS_ACTION].reshape(-1)
    positions = data[STATE][:, response.states].double()
    action = torch.where(labelled.unsqueeze(-1), data[ACTION][:, response.actions].double(), torch.nan)
    if response.absolute:
        after = action
        changes = torch.where(begins(data).unsqueeze(-1), torch.nan, action.diff(dim=0, prepend=action[:1]))
    else:
        changes = action
        after = data[OBSERVATION][:, response.commands].double() + changes
    row = torch.arange(memory, len(episode) - 1, device=episode.device)
    measured, commanded = (~values.isnan().any(-1) for values in (positions, changes))
    good = _around(measured, row, -memory, 1).all(-1) & _around(commanded, row, -memory, -1).all(-1)
    row = row[good & (episode[row - memory] == episode[row + 1])]
    broken = torch.ones_like(row, dtype=torch.bool)
    broken[1:] = row.diff() != 1  # also at a new episode, whose first `memory` rows are left out
    segment = broken.cumsum(0) - 1
    known = ~after[row - 1].isnan().any(-1)
    # a hidden command is summed up from the beginning of its stretch
    total = changes[row - 1].cumsum(0)
    counted = total - (total - changes[row - 1])[broken][segment]
    command = torch.where(known.unsqueeze(-1), after[row - 1], counted)
    history, past = _around(positions, row, -memory, 0), _around(changes, row, -memory, -1)
    read = response.coordinates(history, command - positions[row], past)
    steps = (positions[row + 1] - positions[row]).reshape(-1, axes)
    return LabelledSteps(read, steps, segment, known, row, batch_size=[len(row)]), changes


def _fit(
    response: ResponseModel, data: TensorDictBase, steps: LabelledSteps, changes: Tensor, *, coupled: bool
) -> None:
    """Fits a ridge, without the means of stretches with unknown commands, then predictions over many steps."""
    read, wanted = steps.coordinates, steps.steps
    if not steps.known.all():
        _, group, size = steps.segment.unique(return_inverse=True, return_counts=True)
        hidden = (~steps.known).to(read.dtype)
        means = []
        for value in (read.flatten(1), wanted):
            total = value.new_zeros(len(size), value.shape[1]).index_add_(0, group, value)
            means.append((total / size.unsqueeze(-1))[group] * hidden.unsqueeze(-1))
        read, wanted = read - means[0].view_as(read), wanted - means[1]
    response.fit_ridge(read, wanted, penalty=PENALTY, coupled=coupled)
    fit_predictions(response, _stretches(response, data, steps, changes), coupled=coupled)


def _folds(steps: LabelledSteps) -> Tensor | None:
    """Returns the fold of each step ``[n]``: whole stretches, or blocks if these are few. None for too few steps."""
    count = int(steps.segment[-1]) + 1
    if count >= _FOLDS:
        return steps.segment % _FOLDS
    if len(steps.row) < _FOLDS * _LEAST:
        return None
    return torch.arange(len(steps.row), device=steps.row.device) * _FOLDS // len(steps.row)


def _stretches(response: ResponseModel, data: TensorDictBase, steps: LabelledSteps, changes: Tensor) -> Stretches:
    """Cuts a stretch at every second step: :data:`AHEAD` labelled steps, or the longest unbroken row if shorter."""
    row, memory = steps.row, response.memory
    length = min(AHEAD, int(steps.segment.bincount().max()))
    enough = torch.zeros_like(row, dtype=torch.bool)
    enough[: len(row) - length + 1] = row[length - 1 :] - row[: len(row) - length + 1] == length - 1
    start = steps[enough][::2]
    row = start.row
    positions = data[STATE][:, response.states].double()
    return Stretches(
        _around(positions, row, -memory, 0),
        positions[row] + start.coordinates[..., memory],  # the lead
        _around(changes, row, -memory, -1),
        _around(changes, row, 0, length - 1).nan_to_num(0.0),  # the last change has no effect
        _around(positions, row, 1, length),
        start.known,
        batch_size=[len(row)],
    )


def prediction_errors(response: ResponseModel, stretches: Stretches, weight: Tensor | None = None) -> Tensor:
    """Returns errors of predicted positions ``[n, N, J]``, in the unit of the axes; differentiable in the weight.

    A hidden command is known up to a constant, whose effect is linear. The error is the part that no constant explains
    (fixed effects).
    """
    given = stretches.positions, stretches.command, stretches.changes, stretches.future
    error = response.predict(*given, weight=weight) - stretches.measured
    if stretches.known.all():
        return error
    axes, steps, memory = response.num_axes, error.shape[1], response.memory
    still, constants = error.new_zeros(axes, memory + 1, axes), torch.eye(axes).to(error)
    effect = response.predict(still, constants, still[:, 1:], still.new_zeros(axes, steps, axes), weight=weight)
    effect = effect.flatten(1)
    with torch.no_grad():  # at the best constants, the gradient of the squared errors with respect to them is zero
        best = torch.linalg.lstsq(effect.T, error.flatten(1).T).solution.T * ~stretches.known.unsqueeze(-1)
    return error - (best @ effect).view_as(error)


def fit_predictions(response: ResponseModel, stretches: Stretches, *, coupled: bool) -> None:
    """Refines the coefficients such that positions are predicted best over whole stretches (simulation error).

    A fit to single steps explains residuals by a shorter memory or a weaker pull of the command; the error then grows
    with every predicted step. Coefficients that the stretches determine poorly stay near their present values
    (:data:`STAY`); without stretches nothing changes. Coupled axes have cross-axis terms.
    """
    if not len(stretches):
        return
    if len(stretches) > MOST:
        stretches = stretches[torch.arange(MOST, device=stretches.known.device) * len(stretches) // MOST]
    now, axes = stretches.positions[:, -1], response.num_axes
    read = response.coordinates(stretches.positions, stretches.command - now, stretches.changes)
    size = read.square().mean(0).sqrt().clamp_min(1e-12)
    unit = (stretches.measured[:, 0] - now).square().mean().sqrt() / size
    if not coupled:
        unit = unit * torch.eye(axes).to(unit).unsqueeze(-1)
    spread = (stretches.measured - now.unsqueeze(1)).square().mean((0, 1)).sqrt().clamp_min(1e-12)
    start = response.weight.to(now)
    moved = torch.zeros_like(start, requires_grad=True)
    search = torch.optim.LBFGS([moved], max_iter=_ITERATIONS, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        search.zero_grad()
        relative = prediction_errors(response, stretches, start + moved * unit) / spread
        value = relative.square().mean() + STAY * moved.square().mean()
        value.backward()
        return value

    with torch.enable_grad():
        search.step(loss)
    found = (start + moved.detach() * unit).to(response.weight)
    if found.isfinite().all():
        response.weight.copy_(found)
