# This source code is licensed under the MIT license found in the LICENSE file.
"""TorchRL components for imitation learning with few action labels."""

from __future__ import annotations

from torchrl_koap.graphics import import_mujoco
from torchrl_koap.lookup import exports

__version__ = "0.1.0"

import_mujoco()

# imported when first asked for: a network or a task costs no simulator, a version no torch
_LAZY = {
    "Agent": "torchrl_koap.modules",
    "AsynchronousAgent": "torchrl_koap.modules",
    "ControllerConfig": "torchrl_koap.runs.config",
    "Study": "torchrl_koap.studies",
    "EvalConfig": "torchrl_koap.evaluation",
    "Execution": "torchrl_koap.modules",
    "ExecutionConfig": "torchrl_koap.modules",
    "LabelConfig": "torchrl_koap.runs.config",
    "PlannerConfig": "torchrl_koap.runs.config",
    "RunConfig": "torchrl_koap.runs.config",
    "Task": "torchrl_koap.tasks",
    "TrainConfig": "torchrl_koap.runs.config",
    "Trained": "torchrl_koap.training",
    "evaluate": "torchrl_koap.evaluation",
    "fit": "torchrl_koap.training",
    "get_task": "torchrl_koap.tasks",
    "load_policy": "torchrl_koap.evaluation",
    "make_demonstrations": "torchrl_koap.data",
    "register_method": "torchrl_koap.training",
    "register_task": "torchrl_koap.tasks",
    "run_study": "torchrl_koap.studies",
    "save_demonstrations": "torchrl_koap.data",
    "train": "torchrl_koap.training",
}

__all__ = [  # noqa: F822 - __getattr__ finds them
    "Agent",
    "AsynchronousAgent",
    "ControllerConfig",
    "EvalConfig",
    "Execution",
    "ExecutionConfig",
    "LabelConfig",
    "PlannerConfig",
    "RunConfig",
    "Study",
    "Task",
    "TrainConfig",
    "Trained",
    "__version__",
    "evaluate",
    "fit",
    "get_task",
    "load_policy",
    "make_demonstrations",
    "register_method",
    "register_task",
    "run_study",
    "save_demonstrations",
    "train",
]


__getattr__ = exports(__name__, _LAZY)


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})
