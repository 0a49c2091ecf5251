# This source code is licensed under the MIT license found in the LICENSE file.
"""AR(1) noise of the scripted operators."""

from __future__ import annotations

import numpy as np


def ar1_noise(
    generator: np.random.Generator, memory: float, deviation: float, size: int | tuple[int, ...]
) -> np.ndarray:
    """Draws noise ``[*size]`` of an autoregressive process of order one in its steady state.

    Args:
        generator (np.random.Generator): where the draws come from.
        memory (float): steps after which a share 1/e remains.
        deviation (float): standard deviation.
        size (int or tuple of int): number of steps, or a shape that begins with it.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.envs.experts.noise import ar1_noise
        >>> noise = ar1_noise(np.random.default_rng(0), 5, 2.0, 20000)
        >>> print(f"{noise.std():.1f} {np.corrcoef(noise[5:], noise[:-5])[0, 1]:.1f}")
        2.0 0.4
    """
    keep = np.exp(-1 / memory)
    values = generator.normal(0, deviation, size)
    values[1:] *= np.sqrt(1 - keep**2)
    for step in range(1, len(values)):
        values[step] += keep * values[step - 1]
    return values
