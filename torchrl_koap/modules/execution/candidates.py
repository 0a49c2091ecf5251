# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans that keep their word: several are sampled, and one that goes on with the current plan is taken.

A generative planner draws a mode anew at every plan. Between two gaps of equal merit a robot can so be sent towards one
and, a few steps later, towards the other. Sampling several candidates and preferring those near the current plan
(Liu et al. 2024, "Bidirectional Decoding", backward coherence) avoids that. To take the nearest of many would be too
much faith in the old plan; the first drawn of the nearest quarter converges to a distribution of plans as the number of
candidates grows.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

SHARE = 0.25  # of the candidates, any of which may be taken


def steps_apart(candidates: Tensor, previous: Tensor) -> Tensor:
    """Mean square distances ``[*B, N]`` of ``[*B, N, H, w]`` to what is left of a chunk ``[*B, K, w]``, by step."""
    return (candidates[..., : previous.shape[-2], :] - previous.unsqueeze(-3)).square().mean((-2, -1))


def paths_apart(candidates: Tensor, previous: Tensor) -> Tensor:
    """Mean square distances ``[*B, N]`` of the first half of ``[*B, N, H, w]`` to the nearest states of a plan.

    Each state is compared with the nearest one of the plan ``[*B, L, w]``, at whatever time it was meant: a robot that
    lags behind its plan goes on with it by going the same way, not by being where the plan is. The second half would
    reach beyond the end of the plan.
    """
    first = candidates[..., : (candidates.shape[-2] + 1) // 2, :]
    return torch.cdist(first, previous.unsqueeze(-3)).amin(-1).square().mean(-1)


def first_of_nearest(distance: Tensor) -> Tensor:
    """Index ``[*B]`` of the first of the nearest quarter, by distances to the current plan ``[*B, N]``."""
    farthest = distance.kthvalue(max(1, round(SHARE * distance.shape[-1])), -1, keepdim=True).values
    return (distance <= farthest).int().argmax(-1)


def sample_coherent(
    sample: Callable[[Tensor, Tensor | None], Tensor],
    history: Tensor,
    noise: Tensor | None,
    candidates: int,
    *,
    distance: Callable[[Tensor], Tensor] | None = None,
    started: Tensor | None = None,
) -> Tensor:
    """Samples plans (or action chunks) and returns the chosen one of each environment, ``[*B, H, w]``.

    Args:
        sample (callable): ``sample(history [*B, h, d], noise) -> [*B, H, w]``.
        history (Tensor): observed states ``[*B, h, d]``.
        noise (Tensor, optional): start noise ``[*B, candidates, ...]``.
        candidates (int): ``N``.

    Keyword Args:
        distance (callable, optional): of candidates ``[*B, N, H, w]`` to the current plan, ``[*B, N]``. Default: there
            is none, and the first candidate is taken.
        started (Tensor, optional): where an episode begins, bool ``[*B]``: the first candidate is taken there too, so
            that the choice of a mode stays the planner's.
    """
    plans = sample(history.unsqueeze(-3).expand(*history.shape[:-2], candidates, *history.shape[-2:]), noise)
    if distance is None:
        return plans[..., 0, :, :]
    index = first_of_nearest(distance(plans))
    index = index if started is None else index.masked_fill(started, 0)
    return plans.gather(-3, index[..., None, None, None].expand(*index.shape, 1, *plans.shape[-2:])).squeeze(-3)
