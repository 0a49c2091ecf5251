# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations: reading, storing, hiding labels, normalising, cutting into windows."""

from torchrl_koap.data.augmentation import (
    ObjectPermutation,
    RandomPlanarTransform,
    RecoveryAugmentation,
    extrapolate_ends,
)
from torchrl_koap.data.d3il.conversion import Converter, RawFolderError, convert_raw_files, find_raw_files
from torchrl_koap.data.d3il.pickle_scan import DamagedPickleError, UnsafePickleError
from torchrl_koap.data.d3il.raw import RawEpisode, RawEpisodeError, read_raw_episode, write_raw_episode
from torchrl_koap.data.d3il.replay import D3ILExperienceReplay
from torchrl_koap.data.d3il.unpickling import load_pickle, loads_pickle
from torchrl_koap.data.demonstrations import make_demonstrations, save_demonstrations
from torchrl_koap.data.gripper_recovery import GripperRecovery
from torchrl_koap.data.label_budget import LabelBudget, LabelReport, hide_commands
from torchrl_koap.data.lerobot.reader import read_lerobot
from torchrl_koap.data.neighbor_recovery import NeighborRecovery
from torchrl_koap.data.recorded_replay import RecordedExperienceReplay
from torchrl_koap.data.recordings import Recordings, RecordingsError, make_recordings
from torchrl_koap.data.sources import read_recordings
from torchrl_koap.data.subsampling import subsample_trajectories
from torchrl_koap.data.ted import DamagedDataError, load_ted, read_about, read_task, save_ted
from torchrl_koap.data.trajectories import (
    controller_view,
    flatten_trajectories,
    mark_labels,
    select_state,
    trajectory_lengths,
)
from torchrl_koap.data.window_buffer import cut_windows, make_window_buffer
from torchrl_koap.data.window_sampler import WindowSampler, WindowUnit
from torchrl_koap.data.window_sampler_without_replacement import WindowSamplerWithoutReplacement
from torchrl_koap.data.window_table import WindowTable

__all__ = [
    "Converter",
    "D3ILExperienceReplay",
    "DamagedDataError",
    "DamagedPickleError",
    "GripperRecovery",
    "LabelBudget",
    "LabelReport",
    "NeighborRecovery",
    "ObjectPermutation",
    "RandomPlanarTransform",
    "RawEpisode",
    "RawEpisodeError",
    "RawFolderError",
    "RecordedExperienceReplay",
    "Recordings",
    "RecordingsError",
    "RecoveryAugmentation",
    "UnsafePickleError",
    "WindowSampler",
    "WindowSamplerWithoutReplacement",
    "WindowTable",
    "WindowUnit",
    "controller_view",
    "convert_raw_files",
    "cut_windows",
    "extrapolate_ends",
    "find_raw_files",
    "flatten_trajectories",
    "hide_commands",
    "load_pickle",
    "load_ted",
    "loads_pickle",
    "make_demonstrations",
    "make_recordings",
    "make_window_buffer",
    "mark_labels",
    "read_about",
    "read_lerobot",
    "read_raw_episode",
    "read_recordings",
    "read_task",
    "save_demonstrations",
    "save_ted",
    "select_state",
    "subsample_trajectories",
    "trajectory_lengths",
    "write_raw_episode",
]
