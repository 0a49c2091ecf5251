# This source code is licensed under the MIT license found in the LICENSE file.
"""D3IL's manipulation tasks as native-batch TorchRL environments on MuJoCo; importing registers them with Gymnasium."""

from torchrl_koap.envs.aligning import AligningEnv
from torchrl_koap.envs.avoiding import AvoidingEnv
from torchrl_koap.envs.base import ManipulationEnv
from torchrl_koap.envs.registry import ManipulationGymEnv, make_env
from torchrl_koap.envs.scooping import ScoopingEnv
from torchrl_koap.envs.sorting import SortingEnv
from torchrl_koap.envs.stacking import StackingEnv

__all__ = [
    "AligningEnv",
    "AvoidingEnv",
    "ManipulationEnv",
    "ManipulationGymEnv",
    "ScoopingEnv",
    "SortingEnv",
    "StackingEnv",
    "make_env",
]
