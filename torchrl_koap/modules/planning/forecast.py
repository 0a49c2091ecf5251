# This source code is licensed under the MIT license found in the LICENSE file.
"""A linear forecast of the plan, from which a planner learns the deviations alone."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.ridge import ridge

_MOST_ROWS = 20_000  # windows that the ridge is fitted to at most, spread evenly
_NOTHING = 1e-3  # of the spread of an entry: scale of what is forecast without error
_PENALTIES = tuple(10.0**power for power in range(-6, 8))  # the last one leaves next to nothing


class LinearForecast(nn.Module):
    r"""Subtracts a ridge regression on the condition from a sequence, and adds it again.

    .. math:: y = (x - W c - b - \text{offset}) / \text{scale}

    A network that has seen the motions to fifty goals may overfit to these fifty and be wrong between them. A
    linear map of as many numbers as the condition has carries over to new goals wherever the motion is nearly linear in
    what was observed, and elsewhere its penalty, chosen on trajectories left out, makes it vanish. What it takes off
    depends on the condition alone, so no distribution of plans is ruled out by it.

    Args:
        condition_dim (int): number ``c`` of condition columns.
        width (int): number ``w`` of columns of the flat sequence.
    """

    def __init__(self, condition_dim: int, width: int):
        super().__init__()
        self.register_buffer("weight", torch.zeros(width, condition_dim))
        self.register_buffer("bias", torch.zeros(width))
        self.residual = Normalizer(width)

    def fit(self, condition: Tensor, sequence: Tensor, groups: Tensor | None = None) -> float:
        """Fits the ridge and the statistics of what it leaves over, and returns the penalty chosen.

        Args:
            condition (Tensor): normalised conditions ``[N, c]``.
            sequence (Tensor): normalised sequences ``[N, w]``.
            groups (Tensor, optional): trajectory of every row ``[N]``; they are left out one at a time to choose the
                penalty. Default: one row at a time.
        """
        groups = torch.arange(len(condition), device=condition.device) if groups is None else groups
        rows = slice(None, None, -(-len(condition) // _MOST_ROWS))
        fit = ridge(
            condition[rows],
            sequence[rows],
            groups=groups[rows],
            penalties=_PENALTIES,
            default_penalty=_PENALTIES[-1],  # where too few trajectories are there to choose by
        )
        self.weight.copy_(fit.weight)
        self.bias.copy_(fit.bias)
        rest = sequence - self._forecast(condition)
        fitted = Normalizer.fit(rest, mode="standard")
        nothing = (rest - fitted.offset).abs().amax(0) < _NOTHING  # such as a goal that never moves
        scale = torch.where(nothing, _NOTHING, fitted.scale)
        self.residual = Normalizer(len(scale), offset=fitted.offset, scale=scale).to(self.bias)
        return fit.penalty

    def encode(self, condition: Tensor, sequence: Tensor) -> Tensor:
        """Maps normalised sequences ``[*B, w]`` to their deviation from the forecast of conditions ``[*B, c]``."""
        return self.residual(sequence - self._forecast(condition))

    def decode(self, condition: Tensor, deviation: Tensor) -> Tensor:
        """Maps deviations ``[*B, w]`` to sequences; the inverse of :meth:`encode`."""
        return self.residual.inverse(deviation) + self._forecast(condition)

    def _forecast(self, condition: Tensor) -> Tensor:
        return nn.functional.linear(condition, self.weight, self.bias)
