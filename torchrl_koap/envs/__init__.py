# This source code is licensed under the MIT license found in the LICENSE file.
"""D3IL's manipulation tasks as native-batch TorchRL environments on MuJoCo."""

from torchrl_koap.envs.avoiding import AvoidingEnv, mode_index
from torchrl_koap.envs.base import ManipulationEnv

__all__ = ["AvoidingEnv", "ManipulationEnv", "mode_index"]
