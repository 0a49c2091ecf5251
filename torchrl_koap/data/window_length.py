# This source code is licensed under the MIT license found in the LICENSE file.
"""How much of a demonstration a plan covers."""

from __future__ import annotations

import math

from tensordict import TensorDictBase

from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.tasks import HORIZON

SHORT, ENOUGH = 0.02, 0.05  # share of a demonstration that a plan covers: too little, and what would do


def plan_coverage(data: TensorDictBase, control_hz: float) -> tuple[str, str | None]:
    """Says how long a plan is beside the demonstrations.

    Args:
        data (TensorDictBase): flat data ``[N]``.
        control_hz (float): frames per second.

    Returns:
        tuple: both in milliseconds, and a warning where a plan is short against the motion, else None.

    Examples:
        >>> import torch
        >>> from torchrl_koap.data import flatten_trajectories
        >>> from torchrl_koap.data.window_length import plan_coverage
        >>> plan_coverage(flatten_trajectories([torch.zeros(29, 2)], None, action_dim=1), 14.0)
        ('14 frames, 1000 ms; demonstrations last 2000 ms (median)', None)
    """
    frames = float(trajectory_lengths(data).double().median())
    covers = f"{HORIZON} frames, {1e3 * HORIZON / control_hz:.4g} ms"
    lasts = f"demonstrations last {1e3 * frames / control_hz:.4g} ms (median)"
    if HORIZON >= SHORT * frames:
        return f"{covers}; {lasts}", None
    every = math.ceil(ENOUGH * frames / HORIZON)
    return f"{covers}; {lasts}", (
        f"a plan covers {covers}, {HORIZON / frames:.1%} of a demonstration: short against the motion. A rate of"
        f" {control_hz / every:.3g} Hz (one frame in {every}) would let it look farther"
    )
