# This source code is licensed under the MIT license found in the LICENSE file.
"""Many runs: label-efficiency curves and the paper's tables."""

from torchrl_koap.lookup import exports

# imported when first asked for: pictures need a reader of run directories, not TorchRL
_MODULES = {
    "Cell": "torchrl_koap.studies.cells",
    "Machines": "torchrl_koap.studies.launchers",
    "Study": "torchrl_koap.studies.study",
    "run_study": "torchrl_koap.studies.run",
}
__getattr__ = exports(__name__, _MODULES)

__all__ = list(_MODULES)
