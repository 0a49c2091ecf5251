# This source code is licensed under the MIT license found in the LICENSE file.
"""Scores of sampled sequences against recorded ones: the energy score, and the distance from all recordings."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_koap.modules.planning.sampler import ConditionalSampler

_BATCH = 512  # sequences that are processed at once


def energy_score(samples: Tensor, true: Tensor) -> Tensor:
    r"""Computes the energy score ``[*B]`` of samples ``[S, *B, d]``, in their unit; lower is better.

    .. math:: \mathrm{ES} = \mathbb{E}\,\|X - y\| - \tfrac{1}{2}\, \mathbb{E}\,\|X - X'\|

    with the true ``y [*B, d]``. Its mean is lowest for samples of the true distribution with all its modes. The second
    mean is over pairs of different samples; for a single sample the score is the distance. Raises a ValueError if
    shapes disagree.
    """
    if samples.ndim < 2 or samples.shape[1:] != true.shape:
        raise ValueError(f"wanted samples [S, *B, d] and true [*B, d], got {list(samples.shape)}, {list(true.shape)}")
    count = len(samples)
    score = (samples - true).norm(dim=-1).mean(0)
    if count > 1:
        apart = sum((samples - sample).norm(dim=-1).sum(0) for sample in samples)
        score = score - 0.5 * apart / (count * (count - 1))
    return score


@torch.no_grad()
def sample_sequences(sampler: ConditionalSampler, history: Tensor, *, samples: int, seed: int = 0) -> Tensor:
    """Samples ``S`` sequences ``[S, N, H, width]`` from planner or Diffusion Policy for each history ``[N, h, d]``.

    The seed determines their noise; torch's global generator is not used.
    """
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for _ in range(samples):
        noise = torch.randn(len(history), *sampler.noise_shape, generator=generator).to(history)
        parts = zip(history.split(_BATCH), noise.split(_BATCH), strict=True)
        drawn.append(torch.cat([sampler.sample(part, start) for part, start in parts]))
    return torch.stack(drawn)


def relative_score(samples: Tensor, true: Tensor, reference: Tensor, groups: Sequence[Sequence[int]]) -> float:
    """Computes the energy score of samples ``[S, N, H, d]``, divided by that of a reference, such as standing still.

    True and reference are ``[N, H, d]``. Ratios are averaged over ``groups`` of columns, each of one unit. Groups in
    which the reference has no error are left out; NaN is returned if none is left.
    """
    shares = []
    for columns in map(list, groups):
        still = (reference - true)[..., columns].norm(dim=-1).mean()
        if still > 0:
            shares.append(energy_score(samples[..., columns], true[..., columns]).mean() / still)
    return torch.stack(shares).mean().item() if shares else float("nan")


def relative_distance(samples: Tensor, true: Tensor, recorded: Tensor, groups: Sequence[Sequence[int]]) -> float:
    """Computes the distance of samples from the nearest recorded sequence, divided by that of true sequences.

    A blurred plan, or one between two recorded paths, is farther from all recordings than a new recording is; the
    energy score alone hardly detects it. The measure is the precision of generative models (Kynkäänniemi et al. 2019)
    as a mean distance.

    Samples are ``[S, N, H, d]``, recorded sequences ``[M, H, d]``, and true ones, which are not among the recorded,
    ``[N, H, d]``. Ratios are averaged over ``groups`` of columns, each of one unit. Groups in which true sequences have
    the distance 0 are left out; 1 is returned if none is left.
    """
    shares = []
    for columns in map(list, groups):
        far, usual = (_to_nearest(each[..., columns], recorded[..., columns]) for each in (samples, true))
        if usual > 0:
            shares.append(far / usual)
    return torch.stack(shares).mean().item() if shares else 1.0


def _to_nearest(sequences: Tensor, recorded: Tensor) -> Tensor:
    """Computes the mean distance ``[]`` of sequences ``[*B, H, d]`` to the nearest recorded one ``[M, H, d]``."""
    known = recorded.flatten(-2).double()  # distances are small compared with coordinates
    parts = sequences.flatten(0, -3).flatten(-2).double().split(_BATCH)
    return torch.cat([torch.cdist(part, known).amin(-1) for part in parts]).mean()
