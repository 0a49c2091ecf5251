# This source code is licensed under the MIT license found in the LICENSE file.
"""From demonstrations to a trained planner and controller, in a run directory or in memory."""

from torchrl_koap.lookup import exports

# imported when first asked for: a method of one's own needs no training loop
_MODULES = {
    "METHODS": "torchrl_koap.training.methods",
    "Method": "torchrl_koap.training.method",
    "Phase": "torchrl_koap.training.method",
    "Trained": "torchrl_koap.training.trained",
    "fit": "torchrl_koap.training.in_memory",
    "register_method": "torchrl_koap.training.methods",
    "train": "torchrl_koap.training.on_disk",
    "TrainConfig": "torchrl_koap.runs.config",
}
__getattr__ = exports(__name__, _MODULES)

__all__ = list(_MODULES)
