# This source code is licensed under the MIT license found in the LICENSE file.
"""Frames around a step: offsets, scales, windows that are too short."""

from __future__ import annotations

import pytest
import torch

from torchrl_koap.modules import LatentActionMLP
from torchrl_koap.modules.time_alignment import FrameGatherer


def test_equals_the_latent_actions_input_where_both_are_allowed():
    state = torch.randn(3, 5, 16, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frames = FrameGatherer(2, num_past=3, look_ahead=(2, 5), least=1).double()
    latent = LatentActionMLP(2, 4, num_past=3, look_ahead=(2, 5), relative=True).double()
    for part in (frames, latent):
        part.fit_scales(state)
    assert torch.equal(frames(state), latent.gather(state).flatten(-2))


def test_scales_make_every_step_of_unit_spread():
    state = torch.randn(50, 12, 3, generator=torch.Generator().manual_seed(1)).cumsum(1) * torch.tensor(
        [1.0, 1e-3, 5.0]
    )
    frames = FrameGatherer(3, num_past=2, look_ahead=(1, 4), least=1)
    frames.fit_scales(state)
    read = frames(state, frames.span(12)).unflatten(-1, (5, 3))
    steps = read[..., [0, 1, 3, 4], :]
    torch.testing.assert_close(steps.square().mean((0, 1)).sqrt(), torch.ones(4, 3))
    assert torch.equal(read[..., 2, :], state[:, 2:8])


def test_a_column_that_never_moves_is_left_alone():
    state = torch.zeros(4, 12, 1)
    frames = FrameGatherer(1, look_ahead=(1, 2, 3, 4, 5), least=1)
    frames.fit_scales(state)
    assert torch.equal(frames.scales, torch.ones(10, 1))


def test_wrong_windows_and_offsets_are_named():
    frames = FrameGatherer(2, num_past=4, look_ahead=(1, 5), least=1)
    with pytest.raises(ValueError, match="at least 10 frames are needed"):
        frames.span(9)
    with pytest.raises(ValueError, match="2 columns"):
        frames(torch.zeros(10, 3))
    with pytest.raises(ValueError, match="must be >= 1, got"):
        FrameGatherer(2, look_ahead=0, least=1)
