# This source code is licensed under the MIT license found in the LICENSE file.
"""A plan is compared with the demonstrations, and a short one is told."""

from __future__ import annotations

import torch

from torchrl_koap.data import flatten_trajectories
from torchrl_koap.data.window_length import plan_coverage


def test_a_plan_that_is_short_against_the_motion():
    data = flatten_trajectories([torch.zeros(1001, 2)] * 3, None, action_dim=1)
    covers, short = plan_coverage(data, 500.0)
    assert covers == "14 frames, 28 ms; demonstrations last 2000 ms (median)"
    assert "covers 14 frames, 28 ms, 1.4% of a demonstration" in short and "125 Hz (one frame in 4)" in short
    assert plan_coverage(data[:2000:4], 125.0)[1] is None
