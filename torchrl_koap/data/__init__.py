# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations: reading, storing, hiding labels, augmenting, cutting into windows."""

from torchrl_koap.data.demonstrations import make_demonstrations, save_demonstrations
from torchrl_koap.data.formats import Recordings, make_recordings, read_recordings
from torchrl_koap.data.label_budget import LabelBudget
from torchrl_koap.data.recovery import RecoveryAugmentation
from torchrl_koap.data.replay import D3ILExperienceReplay
from torchrl_koap.data.sources import open_dataset
from torchrl_koap.data.symmetries import ObjectPermutation, RandomPlanarTransform
from torchrl_koap.data.ted import load_ted, save_ted
from torchrl_koap.data.trajectories import extrapolate_ends, flatten_trajectories, select_state
from torchrl_koap.data.windows import WindowSampler, WindowTable, WindowUnit, cut_windows, make_window_buffer
from torchrl_koap.files import DataError

__all__ = [
    "D3ILExperienceReplay",
    "DataError",
    "LabelBudget",
    "ObjectPermutation",
    "RandomPlanarTransform",
    "Recordings",
    "RecoveryAugmentation",
    "WindowSampler",
    "WindowTable",
    "WindowUnit",
    "cut_windows",
    "extrapolate_ends",
    "flatten_trajectories",
    "load_ted",
    "make_demonstrations",
    "make_recordings",
    "make_window_buffer",
    "open_dataset",
    "read_recordings",
    "save_demonstrations",
    "save_ted",
    "select_state",
]
