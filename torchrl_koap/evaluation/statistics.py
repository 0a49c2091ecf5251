# This source code is licensed under the MIT license found in the LICENSE file.
"""Numbers that evaluations report: success, entropy of the modes over all episodes or per context, intervals."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import entr
from scipy.stats import binom, binomtest

OUTCOMES = ("timeout", "success", "collision", "error")  # of an episode, by number
_RESAMPLES, _TAIL = 500, (1 - 0.95) / 2  # of a bootstrap; share outside the interval at each end


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Returns both ends, in 0..1, of the Wilson score interval (95 %) of a success rate of at least one trial."""
    interval = binomtest(successes, trials).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def rate(good: Sequence[bool]) -> dict[str, float]:
    """Returns the share of trials that succeeded, its 95 % Wilson interval and their number."""
    low, high = wilson_interval(sum(good), len(good))
    return {"rate": sum(good) / len(good), "low": low, "high": high, "episodes": len(good)}


def mode_entropy(modes: Sequence[int], num_modes: int) -> float:
    """Returns the entropy of modes, logarithm base ``num_modes``: 1 if all are equally frequent, 0 for a single one.

    ``modes`` holds a mode ``0 .. num_modes - 1`` per successful episode; D3IL counts no others.
    """
    if len(modes) < 2 or num_modes < 2:
        return 0.0
    shares = np.bincount(np.asarray(modes, dtype=int)) / len(modes)
    return float(entr(shares).sum() / math.log(num_modes))  # scipy.stats.entropy would be ten times slower


def expected_entropy(episodes: int, num_modes: int) -> float:
    """Returns the exact mean of the mode entropy of ``episodes`` episodes whose modes are drawn uniformly.

    A policy without preferences scores this. It is below 1, since a few episodes cannot fill all modes evenly.
    """
    if episodes < 1 or num_modes < 2:
        return 0.0
    counts = np.arange(episodes + 1)  # of one mode
    chances = binom.pmf(counts, episodes, 1 / num_modes)
    return float(num_modes * (chances * entr(counts / episodes)).sum() / math.log(num_modes))


def conditional_entropy(modes: Sequence[Sequence[int]], num_modes: int, *, unsolved: str = "skip") -> float | None:
    """Returns the mean over contexts of the entropy of modes in each, logarithm base ``num_modes``.

    A single rollout per context always gives 0, so two or more are needed. ``unsolved`` says how contexts without
    success count: ``"skip"`` leaves them out (Sorting, Stacking), ``"zero"`` counts them as 0 (Aligning). Returns None
    if there is nothing to average.
    """
    values = [mode_entropy(seen, num_modes) for seen in modes if len(seen) or unsolved == "zero"]
    return sum(values) / len(values) if values else None


def bootstrap_interval(units: Sequence, statistic: Callable[[Sequence], float | None]) -> tuple[float, float]:
    """Returns the percentile interval (95 %) of a statistic over resampled independent units, corrected for bias.

    Resamples hold fewer distinct units than the sample, so their entropies are lower. The interval is shifted by the
    statistic of the sample minus the mean of the resamples. Resamples whose statistic is None are left out.
    """
    generator = random.Random(0)
    values = [statistic(generator.choices(units, k=len(units))) for _ in range(_RESAMPLES)]
    values = sorted(value for value in values if value is not None)
    shift = statistic(units) - sum(values) / len(values)
    return values[int(_TAIL * (len(values) - 1))] + shift, values[round((1 - _TAIL) * (len(values) - 1))] + shift
