# This source code is licensed under the MIT license found in the LICENSE file.
"""The format of a folder, file or name decides who reads it."""

from __future__ import annotations

import numpy as np
import pytest

from torchrl_koap.data import read_recordings


def test_a_folder_of_tables(tmp_path):
    np.savez(tmp_path / "a.npz", states=np.zeros((5, 2)), actions=np.ones((4, 1)))
    assert read_recordings(tmp_path, control_hz=10).num_labels == 4
    with pytest.raises(ValueError, match="observations: not an option for a folder of tables"):
        read_recordings(tmp_path, control_hz=10, observations=["x"])


def test_an_hdf5_file(tmp_path):
    h5py = pytest.importorskip("h5py", reason="h5py is not installed (extra 'hdf5')")
    with h5py.File(tmp_path / "a.hdf5", "w") as stream:
        stream["data/demo_0/obs/q"] = np.zeros((5, 2))
        stream["data/demo_0/actions"] = np.ones((5, 1))
    assert read_recordings(tmp_path / "a.hdf5", control_hz=10).state_names == ("q_0", "q_1")


def test_nothing_to_read(tmp_path):
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(ValueError, match="holds no recordings that can be read; there are readers for a folder of"):
        read_recordings(tmp_path)
    with pytest.raises(FileNotFoundError, match="none does not exist"):
        read_recordings(tmp_path / "none")
