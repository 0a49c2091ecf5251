# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations: reading, storing, hiding labels, normalising, cutting into windows."""

from torchrl_koap.data.demonstrations import make_demonstrations, save_demonstrations
from torchrl_koap.data.formats import Recordings, make_recordings, read_recordings, write_recordings
from torchrl_koap.data.label_budget import LabelBudget, LabelReport, hide_commands, subsample_trajectories
from torchrl_koap.data.recovery import GripperRecovery, NeighborRecovery, RecoveryAugmentation
from torchrl_koap.data.replay import D3ILExperienceReplay
from torchrl_koap.data.sources import open_dataset
from torchrl_koap.data.symmetries import ObjectPermutation, RandomPlanarTransform
from torchrl_koap.data.ted import load_ted, read_about, save_ted, stored_task
from torchrl_koap.data.trajectories import (
    controller_view,
    extrapolate_ends,
    flatten_trajectories,
    mark_labels,
    select_state,
    select_trajectories,
    trajectory_lengths,
)
from torchrl_koap.data.window_sampler import WindowSampler, WindowUnit
from torchrl_koap.data.windows import WindowTable, cut_windows, make_window_buffer
from torchrl_koap.files import DataError

__all__ = [
    "D3ILExperienceReplay",
    "DataError",
    "GripperRecovery",
    "LabelBudget",
    "LabelReport",
    "NeighborRecovery",
    "ObjectPermutation",
    "RandomPlanarTransform",
    "Recordings",
    "RecoveryAugmentation",
    "WindowSampler",
    "WindowTable",
    "WindowUnit",
    "controller_view",
    "cut_windows",
    "extrapolate_ends",
    "flatten_trajectories",
    "hide_commands",
    "load_ted",
    "make_demonstrations",
    "make_recordings",
    "make_window_buffer",
    "mark_labels",
    "open_dataset",
    "read_about",
    "read_recordings",
    "save_demonstrations",
    "save_ted",
    "select_state",
    "select_trajectories",
    "stored_task",
    "subsample_trajectories",
    "trajectory_lengths",
    "write_recordings",
]
