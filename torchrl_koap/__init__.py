# This source code is licensed under the MIT license found in the LICENSE file.
"""TorchRL components for imitation learning with few action labels."""

from __future__ import annotations

from torchrl_koap.lookup import exports

__version__ = "0.1.0"

# imported when first asked for: a network or a task costs no simulator, a version no torch
_LAZY = {
    "CurveConfig": "torchrl_koap.studies",
    "EvalConfig": "torchrl_koap.evaluation",
    "Task": "torchrl_koap.tasks",
    "TrainConfig": "torchrl_koap.training",
    "evaluate": "torchrl_koap.evaluation",
    "get_task": "torchrl_koap.tasks",
    "load_policy": "torchrl_koap.evaluation",
    "register_method": "torchrl_koap.training",
    "register_task": "torchrl_koap.tasks",
    "run_curve": "torchrl_koap.studies",
    "train": "torchrl_koap.training",
}

__all__ = [  # noqa: F822 - __getattr__ finds them
    "CurveConfig",
    "EvalConfig",
    "Task",
    "TrainConfig",
    "__version__",
    "evaluate",
    "get_task",
    "load_policy",
    "register_method",
    "register_task",
    "run_curve",
    "train",
]


__getattr__ = exports(__name__, _LAZY)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
