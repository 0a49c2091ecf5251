# This source code is licensed under the MIT license found in the LICENSE file.
"""Many runs: label-efficiency curves and the paper's tables."""

from torchrl_koap.lookup import exports

# imported on first access: pictures need run directories, but not TorchRL
_OFFERS = {"cells": ("Cell",), "launchers": ("Machines",), "run": ("run_study",), "study": ("Study",)}
__getattr__, __all__ = exports(__name__, _OFFERS)
