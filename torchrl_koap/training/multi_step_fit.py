# This source code is licensed under the MIT license found in the LICENSE file.
"""Fitting the response of a robot to what it predicts over several steps, by nonlinear least squares."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_koap.modules import ResponseModel

MOST = 4000  # stretches that are predicted; of more, so many are taken at equal distances
STAY = 1e-3  # weight of a change of the coefficients, in mean steps per mean coordinate, against relative errors
_ITERATIONS = 30


class Stretches(NamedTuple):
    """Stretches of labelled steps of equal length ``N``, to predict the measured positions of.

    Args:
        positions (Tensor): measured before each ``[n, memory + 1, J]``, the present one last.
        command (Tensor): the last command ``[n, J]``.
        changes (Tensor): that led to it ``[n, memory, J]``.
        future (Tensor): changes of the command to come ``[n, N, J]``.
        measured (Tensor): positions to come ``[n, N, J]``.
        known (Tensor): whether the command itself is known, or counted from an unknown place, bool ``[n]``.
    """

    positions: Tensor
    command: Tensor
    changes: Tensor
    future: Tensor
    measured: Tensor
    known: Tensor

    def take(self, chosen: Tensor) -> Stretches:
        """Some of them."""
        return Stretches(*(field[chosen] for field in self))


def prediction_errors(response: ResponseModel, stretches: Stretches, weight: Tensor | None = None) -> Tensor:
    """Errors of predicted positions ``[n, N, J]``, in the unit of the axes.

    A command that is counted from an unknown place is wrong by a constant. Its effect is linear: only what no constant
    explains is an error (fixed effects).

    Args:
        response (ResponseModel): the model.
        stretches (Stretches): ``n``, of ``N`` steps.
        weight (Tensor, optional): coefficients in place of the model's own. Gradients pass through them.
    """
    given = stretches.positions, stretches.command, stretches.changes, stretches.future
    error = response.predict(*given, weight=weight) - stretches.measured
    if stretches.known.all():
        return error
    axes, steps, memory = response.num_axes, error.shape[1], response.memory
    still, constants = error.new_zeros(axes, memory + 1, axes), torch.eye(axes).to(error)
    effect = response.predict(still, constants, still[:, 1:], still.new_zeros(axes, steps, axes), weight=weight)
    effect = effect.flatten(1)
    with torch.no_grad():  # at the best constants the errors do not change with them to first order
        best = torch.linalg.lstsq(effect.T, error.flatten(1).T).solution.T * ~stretches.known.unsqueeze(-1)
    return error - (best @ effect).view_as(error)


def fit_predictions(response: ResponseModel, stretches: Stretches, *, coupled: bool) -> None:
    """Changes the coefficients such that positions are predicted best over the whole stretches (simulation error).

    A fit to single steps takes what it cannot explain for a shorter memory or a weaker pull of the command; the error
    then grows with every step that is predicted. Coefficients stay near the ones that the response has
    (:data:`STAY`), where stretches tell little.

    Args:
        response (ResponseModel): the model, fitted to single steps; its weights are set.
        stretches (Stretches): to predict. Without any, nothing changes.

    Keyword Args:
        coupled (bool): an axis may answer the commands of others.
    """
    if not len(stretches.known):
        return
    if len(stretches.known) > MOST:
        stretches = stretches.take(torch.arange(MOST, device=stretches.known.device) * len(stretches.known) // MOST)
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
