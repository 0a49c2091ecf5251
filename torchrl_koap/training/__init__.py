# This source code is licensed under the MIT license found in the LICENSE file.
"""From demonstrations to a run directory with planner and controller."""

from torchrl_koap.training.config import ResolvedConfig, TrainConfig, resolve
from torchrl_koap.training.datasets import load_demonstrations
from torchrl_koap.training.fit import Recipe, fit_controller, fit_planner
from torchrl_koap.training.methods import METHODS, Method, Phase, get_method, register_method
from torchrl_koap.training.plugins import PluginError, load_plugins
from torchrl_koap.training.run import train
from torchrl_koap.training.run_directory import RunDirectory, RunDirectoryError

__all__ = [
    "METHODS",
    "Method",
    "Phase",
    "PluginError",
    "Recipe",
    "ResolvedConfig",
    "RunDirectory",
    "RunDirectoryError",
    "TrainConfig",
    "fit_controller",
    "fit_planner",
    "get_method",
    "load_demonstrations",
    "load_plugins",
    "register_method",
    "resolve",
    "train",
]
