# This source code is licensed under the MIT license found in the LICENSE file.
"""Plans that keep their word: several are sampled, and one that goes on with the plan in force is taken.

A generative planner draws a mode anew at every plan. Between two gaps of equal merit a robot can so be sent towards one
and, a few steps later, towards the other. Sampling several candidates and preferring those near the plan in force
(Liu et al. 2024, "Bidirectional Decoding", backward coherence) avoids that. To take the nearest of many is too much
faith in the old plan, though: it hardly reacts to what was observed since, and the more so the more candidates there
are. The rules other than ``"nearest"`` converge to a distribution of plans as the number of candidates grows.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_koap.lookup import lookup

MOST_CANDIDATES = 256


def nearest(apart: Tensor, among: Tensor) -> Tensor:
    """The candidate nearest to the plan in force.

    Args:
        apart (Tensor): distance of every candidate to the plan in force, ``[*B, N]``.
        among (Tensor): distances of the candidates to each other, ``[*B, N, N]``.

    Returns:
        Tensor: index of the chosen candidate, ``[*B]``.
    """
    return apart.argmin(-1)


def quarter(apart: Tensor, among: Tensor) -> Tensor:
    """Any one of the nearest quarter: the first that was drawn.

    Args:
        apart (Tensor): distance of every candidate to the plan in force, ``[*B, N]``.
        among (Tensor): distances of the candidates to each other, ``[*B, N, N]``.

    Returns:
        Tensor: index of the chosen candidate, ``[*B]``.
    """
    kept = _nearest_share(apart, 0.25)
    return kept.int().argmax(-1)


def typical(apart: Tensor, among: Tensor) -> Tensor:
    """Of the nearer half the one in its middle, with the least mean distance to the rest of that half.

    Args:
        apart (Tensor): distance of every candidate to the plan in force, ``[*B, N]``.
        among (Tensor): distances of the candidates to each other, ``[*B, N, N]``.

    Returns:
        Tensor: index of the chosen candidate, ``[*B]``.
    """
    kept = _nearest_share(apart, 0.5)
    total = (among * kept.unsqueeze(-2)).sum(-1)
    return torch.where(kept, total, torch.inf).argmin(-1)


RULES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "nearest": nearest,
    "quarter": quarter,
    "typical": typical,
}


def _nearest_share(apart: Tensor, share: float) -> Tensor:
    """Which candidates are among the nearest share, at least one, bool ``[*B, N]``."""
    number = max(1, round(share * apart.shape[-1]))
    last = apart.kthvalue(number, -1, keepdim=True).values
    return apart <= last


def check_candidates(number: int, rule: str) -> None:
    """Refuses what no policy can choose by.

    Args:
        number (int): candidates.
        rule (str): a name in ``RULES``.

    Raises:
        ValueError: for an unknown rule or a number of candidates out of range.
    """
    lookup(RULES, rule, "rule of choice")
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
    rule: str,
    apart: Callable[[Tensor, Tensor], Tensor] = steps_apart,
) -> Tensor:
    """Chooses one of several plans.

    Args:
        candidates (Tensor): plans ``[*B, N, H, d]``, every entry in units of its own spread.
        in_force (Tensor, optional): what is left of the plan in force, ``[*B, K, d]`` with ``K <= H``, in the same
            units. Default: there is none, and the first candidate is taken.
        fresh (Tensor, optional): where an episode begins, bool ``[*B]``: the first candidate is taken there too, so
            that the choice of a mode stays the planner's.
        rule (str): a name in ``RULES``.
        apart (callable): distances ``[*B, N]`` of the candidates to the plan in force. Defaults to
            :func:`steps_apart`.

    Returns:
        Tensor: index of the chosen candidate, ``[*B]``.

    Raises:
        ValueError: for an unknown rule, or a plan in force of another shape.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.execution.candidates import choose
        >>> plans = torch.tensor([[0.0, 0.0], [5.0, 9.0], [5.0, 6.0], [1.0, 1.0]]).unsqueeze(-1)
        >>> choose(plans, torch.tensor([[5.0]]), None, "quarter").item()
        1
    """
    choice = lookup(RULES, rule, "rule of choice")
    batch, number = candidates.shape[:-3], candidates.shape[-3]
    first = torch.zeros(batch, dtype=torch.long, device=candidates.device)
    if in_force is None or number == 1:
        return first
    if in_force.shape[:-2] != batch or in_force.shape[-1] != candidates.shape[-1]:
        raise ValueError(f"the plan in force must be {[*batch, 'K', candidates.shape[-1]]}, got {list(in_force.shape)}")
    flat = candidates.flatten(-2)
    chosen = choice(apart(candidates, in_force), torch.cdist(flat, flat))
    return chosen if fresh is None else torch.where(fresh, first, chosen)


def sample_coherent(
    sample: Callable[[Tensor, Tensor | None], Tensor],
    scale: Callable[[Tensor], Tensor],
    history: Tensor,
    noise: Tensor | None,
    *,
    number: int,
    rule: str,
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
        rule (str): a name in ``RULES``.
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
    index = choose(scale(plans), None if in_force is None else scale(in_force), fresh, rule, apart)
    index = index[..., None, None, None].expand(*index.shape, 1, *plans.shape[-2:])
    return plans.gather(-3, index).squeeze(-3)
