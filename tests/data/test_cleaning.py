# This source code is licensed under the MIT license found in the LICENSE file.
"""Recordings without still ends and without short trajectories: right frames, right actions, and a word of it."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_koap.data import DataError, make_recordings
from torchrl_koap.data.cleaning import drop_short, trim_still

PATH = np.arange(40.0).reshape(20, 2)


def test_frames_and_actions_are_cut_together():
    frames = np.concatenate([PATH[:1].repeat(9, 0), PATH, PATH[-1:].repeat(4, 0)])
    found = trim_still(make_recordings([frames, PATH], [np.arange(33.0)[:, None], None], control_hz=20))
    np.testing.assert_array_equal(found.states, [PATH, PATH])
    np.testing.assert_array_equal(found.actions[0][:, 0], np.arange(9.0, 28))
    assert found.skipped == ("13 still frames of 1 trajectories",) and found.control_hz == 20


def test_short_trajectories_are_left_out_and_named():
    recordings = make_recordings([PATH[:16], PATH[:17], PATH], action_dim=1, sources=["a", "b", "c"])
    found = drop_short(recordings)
    assert found.sources == ("b", "c") and found.skipped == ("a (15 steps)",) and len(found.actions) == 2
    with pytest.raises(DataError, match="no trajectory has the 16 steps of a window"):
        drop_short(make_recordings([PATH[:9]], action_dim=1))
