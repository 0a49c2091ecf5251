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
        "Recipe": "torchrl_koap.training.fit",
        "ResolvedConfig": "torchrl_koap.training.resolved",
        "TrainConfig": "torchrl_koap.runs.config",
        "fit_controller": "torchrl_koap.training.fit",
        "fit_planner": "torchrl_koap.training.fit",
        "get_method": "torchrl_koap.training.methods",
        "load_demonstrations": "torchrl_koap.training.datasets",
        "register_method": "torchrl_koap.training.methods",
        "resolve": "torchrl_koap.training.resolved",
        "train": "torchrl_koap.training.run",
    },
)

__all__ = [  # noqa: F822
    "METHODS",
    "Method",
    "Phase",
    "Recipe",
    "ResolvedConfig",
    "TrainConfig",
    "fit_controller",
    "fit_planner",
    "get_method",
    "load_demonstrations",
    "register_method",
    "resolve",
    "train",
]
