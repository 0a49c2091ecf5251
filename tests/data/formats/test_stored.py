# This source code is licensed under the MIT license found in the LICENSE file.
"""A data set of this library as recordings."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_koap.data import make_recordings, read_recordings, save_demonstrations

STATES = ("x", "width", "y")


@pytest.mark.parametrize("below", ["", "ted"])
def test_what_was_saved_is_read(below, tmp_path):
    rng = np.random.default_rng(0)
    states, actions = [rng.normal(size=(length, 3)) for length in (5, 4, 7)], rng.normal(size=(6, 2))
    actions[3] = np.nan
    recordings = make_recordings(states, [None, None, actions], state_names=STATES, control_hz=20.0)
    save_demonstrations(tmp_path / "arm", recordings, robot=("x",))
    again = read_recordings(tmp_path / "arm" / below)
    assert (again.state_names, again.control_hz, again.num_labels) == (STATES, 20.0, 5)
    np.testing.assert_allclose(again.states[2], recordings.states[2], rtol=1e-6)
    np.testing.assert_allclose(again.actions[2], recordings.actions[2], rtol=1e-6)
    with pytest.raises(ValueError, match="control_hz: not an option for a data set of this library"):
        read_recordings(tmp_path / "arm", control_hz=3)
