# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans that keep their word: several are sampled, and one that goes on with the plan in force is taken.

A generative planner draws a mode anew at every plan. Between two gaps of equal merit a robot can so be sent towards one
and, a few steps later, towards the other. Sampling several candidates and preferring those near the plan in force
(Liu et al. 2024, "Bidirectional Decoding", backward coherence) avoids that. To take the nearest of many would be too
much faith in the old plan; the first drawn of the nearest quarter converges to a distribution of plans as the number of
candidates grows.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

MOST_CANDIDATES = 256


def check_candidates(number: int) -> None:
    """Refuses a number of candidates that is out of range with a ``ValueError``."""
    if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= MOST_CANDIDATES:
        raise ValueError(f"candidates must be an integer in 1..{MOST_CANDIDATES}, got {number!r}")


def steps_apart(candidates: Tensor, in_force: Tensor) -> Tensor:
    """Mean square distance of candidates to what is left of a plan, step by step.

    Args:
        candidates (Tensor): ``[*B, N, H, w]``.
        in_force (Tensor): ``[*B, K, w]``, ``K <= H``.

    Returns:
        Tensor: ``[*B, N]``.

    Raises:
        ValueError: if the plan in force is the longer one.
    """
    if in_force.shape[-2] > candidates.shape[-2]:
        raise ValueError(
            f"the plan in force has {in_force.shape[-2]} steps, the candidates only {candidates.shape[-2]}"
        )
    return (candidates[..., : in_force.shape[-2], :] - in_force.unsqueeze(-3)).square().mean((-2, -1))


def paths_apart(candidates: Tensor, in_force: Tensor) -> Tensor:
    """Mean square distance of the first ``K`` states of candidates to the nearest of a whole plan.

    Each state is compared with the nearest one of the plan, at whatever time it was meant: a robot that lags behind
    its plan goes on with it by going the same way, not by being where the plan is. ``K`` is half of ``H``, so that a
    candidate does not reach beyond the end of the plan.

    Args:
        candidates (Tensor): ``[*B, N, H, w]``.
        in_force (Tensor): ``[*B, L, w]``.

    Returns:
        Tensor: ``[*B, N]``.
    """
    first = candidates[..., : (candidates.shape[-2] + 1) // 2, :]  # [*B, N, K, w]
    return torch.cdist(first, in_force.unsqueeze(-3)).amin(-1).square().mean(-1)


def choose(
    candidates: Tensor,
    in_force: Tensor | None,
    fresh: Tensor | None,
    apart: Callable[[Tensor, Tensor], Tensor] = steps_apart,
) -> Tensor:
    """Chooses the first drawn of the quarter of several plans that is nearest to the plan in force.

    Args:
        candidates (Tensor): plans ``[*B, N, H, d]``, every entry in units of its own spread.
        in_force (Tensor, optional): what is left of the plan in force, ``[*B, K, d]`` with ``K <= H``, in the same
            units. Default: there is none, and the first candidate is taken.
        fresh (Tensor, optional): where an episode begins, bool ``[*B]``: the first candidate is taken there too, so
            that the choice of a mode stays the planner's.
        apart (callable): distances ``[*B, N]`` of the candidates to the plan in force. Defaults to
            :func:`steps_apart`.

    Returns:
        Tensor: index of the chosen candidate, ``[*B]``.

    Raises:
        ValueError: for a plan in force of another shape.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.execution.candidates import choose
        >>> plans = torch.tensor([[0.0, 0.0], [5.0, 9.0], [5.0, 6.0], [1.0, 1.0]]).unsqueeze(-1)
        >>> choose(plans, torch.tensor([[5.0]]), None).item()
        1
    """
    batch, number = candidates.shape[:-3], candidates.shape[-3]
    first = torch.zeros(batch, dtype=torch.long, device=candidates.device)
    if in_force is None or number == 1:
        return first
    if in_force.shape[:-2] != batch or in_force.shape[-1] != candidates.shape[-1]:
        raise ValueError(f"the plan in force must be {[*batch, 'K', candidates.shape[-1]]}, got {list(in_force.shape)}")
    distance = apart(candidates, in_force)
    farthest = distance.kthvalue(max(1, round(0.25 * number)), -1, keepdim=True).values
    chosen = (distance <= farthest).int().argmax(-1)
    return chosen if fresh is None else torch.where(fresh, first, chosen)


def sample_coherent(
    sample: Callable[[Tensor, Tensor | None], Tensor],
    scale: Callable[[Tensor], Tensor],
    history: Tensor,
    noise: Tensor | None,
    *,
    number: int,
    in_force: Tensor | None,
    fresh: Tensor | None,
    apart: Callable[[Tensor, Tensor], Tensor] = steps_apart,
) -> Tensor:
    """Samples plans (or action chunks) and returns the chosen one of each environment.

    Args:
        sample (callable): ``sample(history [*B, h, d], noise) -> [*B, H, w]``.
        scale (callable): ``scale(plan [*B, H, w])`` to units of the columns' spread.
        history (Tensor): observed states ``[*B, h, d]``.
        noise (Tensor, optional): start noise ``[*B, number, ...]``; without that axis if ``number`` is 1.

    Keyword Args:
        number (int): candidates.
        in_force (Tensor, optional): what is left of the plan in force ``[*B, K, w]``.
        fresh (Tensor, optional): where an episode begins, bool ``[*B]``.
        apart (callable): see :func:`choose`.

    Returns:
        Tensor: ``[*B, H, w]``.
    """
    if number == 1:
        return sample(history, noise)
    repeated = history.unsqueeze(-3).expand(*history.shape[:-2], number, *history.shape[-2:])
    plans = sample(repeated, noise)  # [*B, N, H, w]
    index = choose(scale(plans), None if in_force is None else scale(in_force), fresh, apart)
    index = index[..., None, None, None].expand(*index.shape, 1, *plans.shape[-2:])
    return plans.gather(-3, index).squeeze(-3)
