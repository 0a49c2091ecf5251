# This source code is licensed under the MIT license found in the LICENSE file.
"""Embeddings of one embodiment as if another had moved: an affine map, fitted without labels.

The same task, shown by a hand and by a robot, looks different in every frame, and a planner that is trained on both
learns two tasks. Demonstrations of both go through the same phases in the same order, which is enough to tell which
frames belong together; time is normalised rather than warped, a simple form of canonical time warping (Zhou and De la
Torre, 2009).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor


@dataclass(frozen=True)
class Alignment:
    """An affine map of embeddings.

    Args:
        weight (Tensor): ``[E, E]``.
        offset (Tensor): ``[E]``.
        partners (tuple of int): for every demonstration that was moved, which of the other embodiment's it was fitted
            to.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision.alignment import Alignment
        >>> Alignment(2 * torch.eye(3), torch.ones(3), ())(torch.ones(5, 3))[0]
        tensor([3., 3., 3.])
    """

    weight: Tensor
    offset: Tensor
    partners: tuple[int, ...]

    def __call__(self, embeddings: Tensor) -> Tensor:
        """Moved embeddings ``[*B, E]``, of the same dtype and on the same device.

        Args:
            embeddings (Tensor): ``[*B, E]``.
        """
        return (embeddings.to(self.weight) @ self.weight + self.offset).to(embeddings)


def fit_alignment(
    source: Sequence[Tensor],
    target: Sequence[Tensor],
    *,
    phases: int = 40,
    ridge: float = 0.02,
    rounds: int = 20,
    free_rounds: int = 4,
) -> Alignment:
    """Fits the affine map that takes the demonstrations of one embodiment to those of another.

    Two steps take turns until nothing changes: every demonstration of the source gets a partner among those of the
    target, and a ridge regression takes frames at the same share of the way to one another. All partners are chosen
    equally often: if each were free to take the nearest from the beginning, all would end at the one or two that are
    easiest to fit. Once the map is nearly right each is, for a few rounds, since starts and goals need not be shown
    equally often by both.

    Args:
        source (sequence of Tensor): embeddings ``[T_i, E]`` of the demonstrations to move.
        target (sequence of Tensor): embeddings ``[T_j, E]`` of the others.

    Keyword Args:
        phases (int): frames that every demonstration is resampled to. Defaults to ``40``.
        ridge (float): penalty, as a share of the mean variance of the columns. Defaults to ``0.02``.
        rounds (int): turns at most. Defaults to ``20``.
        free_rounds (int): turns afterwards in which partners are simply the nearest. Defaults to ``4``.

    Returns:
        Alignment: to be called with embeddings of the source.

    Raises:
        ValueError: if a side has no demonstrations, a demonstration has fewer than two frames or values that are not
            finite, sizes of embeddings differ, or an option is out of range.

    Examples:
        >>> import torch
        >>> from torchrl_koap.vision.alignment import fit_alignment
        >>> time = torch.linspace(0, 1, 30)[:, None]
        >>> robot = [torch.cat([time, 3 * time], 1), torch.cat([time, -time**2], 1)]
        >>> hand = [part[::2] * 2 + 5 for part in robot]
        >>> fit_alignment(hand, robot).partners
        (0, 1)
    """
    for name, value, least in (
        ("phases", phases, 2),
        ("ridge", ridge, 0),
        ("rounds", rounds, 1),
        ("free_rounds", free_rounds, 0),
    ):
        if not least <= value < math.inf:
            raise ValueError(f"{name} must be at least {least} and finite, got {value}")
    moved, fixed = (_resampled(parts, side, phases) for parts, side in ((source, "source"), (target, "target")))
    if moved.shape[-1] != fixed.shape[-1]:
        raise ValueError(f"source and target have embeddings of {moved.shape[-1]} and {fixed.shape[-1]} columns")
    frames = moved.flatten(0, 1)
    mean = frames.mean(0)
    centred = frames - mean
    gram = centred.T @ centred
    penalty = ridge * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    solve = torch.linalg.pinv(gram + penalty, hermitian=True) @ centred.T
    weight, offset = torch.eye(len(gram), dtype=gram.dtype), fixed.flatten(0, 1).mean(0) - mean
    partners = torch.empty(0, dtype=torch.long)
    for most, times in ((rounds, -(-len(moved) // len(fixed))), (free_rounds, len(moved))):
        for _ in range(most):
            chosen = _partners((frames @ weight + offset).view_as(moved), fixed, times)
            if chosen.equal(partners):
                break
            partners = chosen
            wanted = fixed[partners].flatten(0, 1)
            weight = solve @ (wanted - wanted.mean(0))
            offset = wanted.mean(0) - mean @ weight
    return Alignment(weight, offset, tuple(partners.tolist()))


def _partners(moved: Tensor, fixed: Tensor, times: int) -> Tensor:
    """The nearest of ``fixed`` for each of ``moved``, none taken more often than so many times ``[N]``."""
    distances = torch.cdist(moved.flatten(1), fixed.flatten(1)).square()
    if times >= len(moved):
        return distances.argmin(1)
    _, place = linear_sum_assignment(distances.repeat_interleave(times, dim=1).numpy())
    return torch.from_numpy(place // times)


def _resampled(parts: Sequence[Tensor], side: str, phases: int) -> Tensor:
    """Every demonstration at the same shares of its way ``[N, phases, E]``."""
    if not parts:
        raise ValueError(f"an alignment needs demonstrations on both sides, {side} has none")
    rows = []
    for number, part in enumerate(parts):
        if len(part) < 2 or not part.isfinite().all():
            what = "values that are not finite" if len(part) > 1 else "fewer than two frames"
            raise ValueError(f"{side}: demonstration {number} has {what}, an alignment needs two and finite ones")
        place = torch.linspace(0, len(part) - 1, phases, dtype=torch.double)
        before = place.long().clamp(max=len(part) - 2)
        part = part.double().cpu()  # so is what assigns partners
        rows.append(torch.lerp(part[before], part[before + 1], (place - before)[:, None]))
    if len({row.shape[-1] for row in rows}) > 1:
        raise ValueError(f"{side}: the demonstrations have embeddings of different sizes")
    return torch.stack(rows)
