# This source code is licensed under the MIT license found in the LICENSE file.
"""TorchRL components for imitation learning with few action labels."""

from __future__ import annotations

from torchrl_koap.graphics import import_mujoco
from torchrl_koap.lookup import exports

__version__ = "0.1.0"

import_mujoco()

# imported on first access: networks and tasks load no simulator, the version loads no torch
_OFFERS = {
    "data": ("make_demonstrations", "save_demonstrations"),
    "evaluation": ("EvalConfig", "evaluate", "load_policy"),
    "modules": ("Agent", "AsynchronousAgent", "Execution", "ExecutionConfig"),
    "runs.config": ("ControllerConfig", "LabelConfig", "PlannerConfig", "RunConfig", "TrainConfig"),
    "studies": ("Study", "run_study"),
    "tasks": ("Task", "get_task", "register_task"),
    "training": ("Trained", "fit", "register_method", "train"),
}
__getattr__, _lazy = exports(__name__, _OFFERS)

__all__ = ["__version__", *_lazy]


def __dir__() -> list[str]:
    return sorted({*globals(), *_lazy})
