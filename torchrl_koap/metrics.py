# This source code is licensed under the MIT license found in the LICENSE file.
"""Numbers that evaluations report: success with its interval, entropy of the modes."""

from __future__ import annotations

import math
from collections.abc import Sequence


def wilson_interval(successes: int, trials: int, *, z: float = 1.959963984540054) -> tuple[float, float]:
    """Wilson score interval of a success rate (95 % by default).

    Raises:
        ValueError: if there are no trials, or more successes than trials.

    Examples:
        >>> from torchrl_koap.metrics import wilson_interval
        >>> [round(bound, 3) for bound in wilson_interval(60, 60)]
        [0.94, 1.0]
    """
    if trials < 1 or not 0 <= successes <= trials:
        raise ValueError(f"expected 0 <= successes <= trials and trials >= 1, got {successes} of {trials}")
    rate, weight = successes / trials, z * z / trials
    centre = (rate + weight / 2) / (1 + weight)
    spread = z / (1 + weight) * math.sqrt(rate * (1 - rate) / trials + weight / (4 * trials))
    low = 0.0 if successes == 0 else centre - spread
    high = 1.0 if successes == trials else centre + spread
    return low, high


def mode_entropy(modes: Sequence[int], num_modes: int) -> float:
    """Entropy of the modes seen, logarithm base ``num_modes``: 1 if all are equally frequent, 0 for a single one.

    Args:
        modes (sequence of int): one mode ``0 .. num_modes - 1`` per successful episode (D3IL counts no others).
        num_modes (int): number of possible modes.

    Raises:
        ValueError: for a mode out of range.

    Examples:
        >>> from torchrl_koap.metrics import mode_entropy
        >>> mode_entropy([0, 1, 2, 3], 4), mode_entropy([2, 2, 2], 4), mode_entropy([], 4)
        (1.0, 0.0, 0.0)
    """
    counts = [0] * num_modes
    for mode in modes:
        if not 0 <= mode < num_modes:
            raise ValueError(f"mode {mode} is not in 0..{num_modes - 1}")
        counts[mode] += 1
    total = sum(counts)
    return sum(-n / total * math.log(n / total, num_modes) for n in counts if n) + 0.0
