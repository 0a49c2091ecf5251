# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner: a generative model of the next states given the last observed ones. It never sees an action."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor, nn

from torchrl_koap import keys
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.sampler import ConditionalSampler
from torchrl_koap.modules.ridge import ridge

_MOST_ROWS = 20_000  # windows that the ridge is fitted to at most, spread evenly
_NOTHING = 1e-3  # of the spread of an entry: scale of what is forecast without error
_PENALTIES = tuple(10.0**power for power in range(-6, 8))  # the last one leaves next to nothing


class LinearForecast(nn.Module):
    r"""Subtracts a ridge regression on the condition ``[*B, c]`` from a flat sequence ``[*B, w]``, and adds it again.

    .. math:: y = (x - W c - b - \text{offset}) / \text{scale}

    A network that has seen the motions to fifty goals may overfit to these fifty and be wrong between them. A linear
    map of as many numbers as the condition has carries over to new goals wherever the motion is nearly linear in what
    was observed, and elsewhere its penalty, chosen on trajectories left out, makes it vanish. What it takes off depends
    on the condition alone, so no distribution of plans is ruled out by it.
    """

    def __init__(self, condition_dim: int, width: int):
        super().__init__()
        self.register_buffer("weight", torch.zeros(width, condition_dim))
        self.register_buffer("bias", torch.zeros(width))
        self.residual = Normalizer(width)

    def fit(self, condition: Tensor, sequence: Tensor, groups: Tensor | None = None) -> float:
        """Fits the ridge and the statistics of what it leaves over, and returns the penalty chosen.

        Of normalised conditions ``[N, c]`` and sequences ``[N, w]``, trajectories (``groups [N]``) are left out one at
        a time to choose the penalty, or single rows where there are none.
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
        fitted = Normalizer.fit(rest, mode="moving")
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


class StatePlanner(ConditionalSampler):
    """Samples the next ``horizon`` states given the last ``history`` ones: KOAP's pi_PL(x_{t+1:t+H} | x_{t-h+1:t}).

    With ``relative=True`` a plan is modelled as displacements from the present state, and the condition is the
    displacement of the older frames together with the present state itself::

        frame        0      1       2      3          (history = 2)
                     x_0    x_1     x_2    x_3
        condition    x_0-x_1, x_1
        plan                        x_2-x_1, x_3-x_1, ...

    With ``forecast=True`` it is not the plan that is modelled but its deviation from a linear forecast
    (:class:`LinearForecast`), which carries over to goals never seen.

    Every entry of condition and plan has its own offset and scale (:meth:`fit_normalizers`); they travel in the state
    dict. Conditions are scaled by their range, plans by their spread while they move (``"moving"`` of
    :meth:`Normalizer.fit`). By range first frames would be a tenth as wide as last ones, and the noise of the schedule
    would cover them. By standard deviation an object that rarely moves would outweigh the robot in the loss.

    Args as for :class:`~torchrl_koap.modules.planning.sampler.ConditionalSampler`, like keywords that are not listed; a
    sequence is a plan, of ``d`` columns.

    Keyword Args:
        state_dim (int): number ``d`` of state columns.
        relative (bool): model displacements from the present state. Defaults to True.
        forecast (bool): model deviations from a linear forecast. Defaults to False.
        out_keys (list of NestedKey): the entry of the plan ``[*B, H, d]``. Defaults to ``["plan"]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import StatePlanner, TemporalUnet
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2, num_steps=4)
        >>> windows = torch.randn(100, 16, 2).cumsum(1)
        >>> planner.fit_normalizers(windows)
        >>> planner(TensorDict({"history": windows[:5, :2]}, [5]))["plan"].shape
        torch.Size([5, 14, 2])
    """

    def __init__(
        self,
        denoiser: nn.Module,
        *,
        state_dim: int,
        relative: bool = True,
        forecast: bool = False,
        out_keys: Sequence[NestedKey] = (keys.PLAN,),
        **options: Any,
    ):
        options |= {"relative": relative, "out_keys": out_keys}
        super().__init__(denoiser, state_dim=state_dim, width=state_dim, **options)
        entries = self.horizon * state_dim
        self.plan_normalizer = Normalizer(entries)
        self.forecast = LinearForecast(len(self.condition_normalizer.scale), entries) if forecast else None

    def fit_normalizers(self, windows: Tensor, *, seen: Tensor | None = None, groups: Tensor | None = None) -> None:
        """Takes the statistics of condition and plan from data; call it before a loss is built on the planner.

        Raw states are windows ``[*N, history + horizon, d]``, padded as those that are trained on: where ends stand
        still in training alone, their plans are far out of the range of the network. The forecast is fitted to the
        windows as training augments them, if they are ``seen``, by trajectories (``groups [*N]``).
        """
        history, plan = self.split_window(windows.reshape(-1, *windows.shape[-2:]))
        example = self.plan_normalizer.scale
        self.condition_normalizer = Normalizer.fit(self.condition(history)).to(example)
        self.plan_normalizer = Normalizer.fit(self._displaced(history, plan), mode="moving").to(example)
        if self.forecast is not None:
            history, plan = self.split_window((windows if seen is None else seen).reshape(-1, *windows.shape[-2:]))
            plan = self.plan_normalizer(self._displaced(history, plan))
            groups = None if groups is None else groups.flatten()
            self.forecast.fit(self.encode_history(history), plan, groups)

    def encode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps raw plans ``[*B, H, d]`` to normalised sequences (:meth:`ConditionalSampler.encode`)."""
        self.check_sequence(sequence)
        sequence = self.plan_normalizer(self._displaced(history, sequence))
        if self.forecast is not None:
            sequence = self.forecast.encode(self.encode_history(history), sequence)
        return sequence.unflatten(-1, self.noise_shape)

    def decode(self, history: Tensor, sequence: Tensor) -> Tensor:
        """Maps normalised sequences ``[*B, H, d]`` to raw plans (:meth:`ConditionalSampler.decode`)."""
        sequence = sequence.flatten(-2)
        if self.forecast is not None:
            sequence = self.forecast.decode(self.encode_history(history), sequence)
        plan = self.plan_normalizer.inverse(sequence).unflatten(-1, self.noise_shape)
        return plan + history[..., -1:, :] if self.relative else plan

    def _displaced(self, history: Tensor, plan: Tensor) -> Tensor:
        """Raw plans as they are modelled, flat ``[*B, H * d]``."""
        return (plan - history[..., -1:, :] if self.relative else plan).flatten(-2)
