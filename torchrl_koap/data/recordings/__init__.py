# This source code is licensed under the MIT license found in the LICENSE file.
"""A user's own recordings: arrays, folders of tables, HDF5 files and Minari data sets."""

from torchrl_koap.data.recordings.minari import read_minari
from torchrl_koap.data.recordings.recordings import Recordings, RecordingsError, make_recordings
from torchrl_koap.data.recordings.robomimic import read_robomimic
from torchrl_koap.data.recordings.tables import read_tables

__all__ = ["Recordings", "RecordingsError", "make_recordings", "read_minari", "read_robomimic", "read_tables"]
