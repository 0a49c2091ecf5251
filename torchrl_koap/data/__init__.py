# This source code is licensed under the MIT license found in the LICENSE file.
"""Demonstrations: reading, storing, hiding labels, normalising, cutting into windows."""

from torchrl_koap.data.augmentation import (
    ExchangeAugmentation,
    RecoveryAugmentation,
    SceneAugmentation,
    extrapolate_ends,
)
from torchrl_koap.data.conversion import CONVERTERS, Converter, RawFolderError, convert_raw_files, find_raw_files
from torchrl_koap.data.d3il import D3ILExperienceReplay
from torchrl_koap.data.labels import LabelBudget, LabelReport, hide_commands
from torchrl_koap.data.lerobot import read_lerobot
from torchrl_koap.data.normalizers import Normalizer
from torchrl_koap.data.observation_budget import limit_observations
from torchrl_koap.data.raw import RawEpisode, RawEpisodeError, read_raw_episode, write_raw_episode
from torchrl_koap.data.saving import replacing_file, replacing_folder
from torchrl_koap.data.ted import DamagedDataError, load_ted, read_about, save_ted
from torchrl_koap.data.trajectories import controller_view, flatten_trajectories, select_state, trajectory_lengths
from torchrl_koap.data.unpickling import DamagedPickleError, UnsafePickleError, load_pickle, loads_pickle
from torchrl_koap.data.window_buffer import cut_windows, make_window_buffer
from torchrl_koap.data.window_table import WindowTable
from torchrl_koap.data.windows import WindowSampler, WindowSamplerWithoutReplacement, WindowUnit

__all__ = [
    "CONVERTERS",
    "Converter",
    "D3ILExperienceReplay",
    "DamagedDataError",
    "DamagedPickleError",
    "ExchangeAugmentation",
    "LabelBudget",
    "LabelReport",
    "Normalizer",
    "RawEpisode",
    "RawEpisodeError",
    "RawFolderError",
    "RecoveryAugmentation",
    "SceneAugmentation",
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
    "limit_observations",
    "load_pickle",
    "load_ted",
    "loads_pickle",
    "make_window_buffer",
    "read_about",
    "read_lerobot",
    "read_raw_episode",
    "replacing_file",
    "replacing_folder",
    "save_ted",
    "select_state",
    "trajectory_lengths",
    "write_raw_episode",
]
