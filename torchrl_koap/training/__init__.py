# This source code is licensed under the MIT license found in the LICENSE file.
"""From demonstrations to a trained planner and controller, in a run directory or in memory."""

from torchrl_koap.lookup import exports

# imported on first access: a module that only registers a method needs no training loop
_OFFERS = {
    "in_memory": ("fit",),
    "method": ("Method", "Phase"),
    "methods": ("METHODS", "register_method"),
    "networks": ("NETWORKS", "register_network"),
    "on_disk": ("TrainConfig", "train"),
    "trained": ("Trained",),
}
__getattr__, __all__ = exports(__name__, _OFFERS)
