# This source code is licensed under the MIT license found in the LICENSE file.
"""From demonstrations to a run directory with planner and controller."""

from torchrl_koap.lookup import exports

# imported when first asked for: pictures need a reader of run directories, not TorchRL
__getattr__ = exports(
    __name__,
    {
        "METHODS": "torchrl_koap.training.methods",
        "Method": "torchrl_koap.training.method",
        "Phase": "torchrl_koap.training.method",
        "PluginError": "torchrl_koap.training.plugins",
        "Recipe": "torchrl_koap.training.fit",
        "ResolvedConfig": "torchrl_koap.training.resolved",
        "RunDirectory": "torchrl_koap.training.run_directory",
        "RunDirectoryError": "torchrl_koap.training.run_directory",
        "TrainConfig": "torchrl_koap.training.config",
        "fit_controller": "torchrl_koap.training.fit",
        "fit_planner": "torchrl_koap.training.fit",
        "get_method": "torchrl_koap.training.methods",
        "load_demonstrations": "torchrl_koap.training.datasets",
        "load_plugins": "torchrl_koap.training.plugins",
        "register_method": "torchrl_koap.training.methods",
        "resolve": "torchrl_koap.training.resolved",
        "train": "torchrl_koap.training.run",
    },
)

__all__ = [  # noqa: F822
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
