# This source code is licensed under the MIT license found in the LICENSE file.
"""What is written in another format is read back: numbers, what is unknown, names, rate."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_koap.data import read_recordings, save_demonstrations
from torchrl_koap.data.recordings import RecordingsError, make_recordings
from torchrl_koap.data.recordings.writers import WRITERS, recordings_of, write_recordings

STATES, ACTIONS = ("x", "width", "y"), ("force", "turn")
NEEDS = {"robomimic": "h5py", "lerobot": "pyarrow", "lerobot-2.1": "pyarrow", "minari": "minari"}
PLACES = {"robomimic": "demo.hdf5", "minari": "minari:koap/demo-v0"}


@pytest.fixture
def recordings():
    rng = np.random.default_rng(0)
    states = [rng.normal(size=(length, 3)) for length in (5, 4, 7)]
    actions = [rng.normal(size=(4, 2)), None, rng.normal(size=(6, 2))]
    actions[2][3] = np.nan
    return make_recordings(states, actions, state_names=STATES, action_names=ACTIONS, control_hz=20.0)


@pytest.mark.parametrize("kind", [kind for kind in WRITERS if kind != "d3il"])  # which is for its own tasks
def test_round_trip(kind, recordings, tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    if kind in NEEDS:
        pytest.importorskip(NEEDS[kind])
    place = PLACES.get(kind, "demo")
    out = write_recordings(recordings, place if kind == "minari" else tmp_path / place, kind)
    options = {"observations": STATES} if kind == "robomimic" else {}
    again = read_recordings(str(out), **options)
    tolerance = 1e-6 if kind.startswith("lerobot") else 0
    assert len(again.states) == 3 and again.num_labels == 9 and again.control_hz == 20
    for index in range(3):
        np.testing.assert_allclose(again.states[index], recordings.states[index], rtol=tolerance, atol=tolerance)
        np.testing.assert_allclose(again.actions[index], recordings.actions[index], rtol=tolerance, atol=tolerance)
    assert again.state_names == STATES
    assert again.action_names == (("action_0", "action_1") if kind == "robomimic" else ACTIONS)


def test_a_data_set_of_this_library(recordings, tmp_path):
    save_demonstrations(tmp_path / "arm", recordings, robot=("x",))
    again = recordings_of(tmp_path / "arm")
    assert (again.state_names, again.control_hz, again.num_labels) == (STATES, 20.0, 9)
    np.testing.assert_allclose(again.states[2], recordings.states[2], rtol=1e-6)
    np.testing.assert_allclose(again.actions[2], recordings.actions[2], rtol=1e-6)


def test_refusals(recordings, tmp_path):
    with pytest.raises(ValueError, match="unknown format 'lerobt'; did you mean 'lerobot'"):
        write_recordings(recordings, tmp_path / "a", "lerobt")
    (tmp_path / "there").mkdir()
    with pytest.raises(FileExistsError, match="there exists already"):
        write_recordings(recordings, tmp_path / "there", "npz")
    unknown = make_recordings([np.zeros((5, 1))], [np.zeros((4, 1))])
    with pytest.raises(RecordingsError, match="the rate is not known"):
        write_recordings(unknown, tmp_path / "b", "lerobot")
