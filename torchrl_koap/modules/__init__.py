# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks as TensorDictModules: planners, liftings, latent actions, decoders and policies."""

from torchrl_koap.modules.baselines.latents import QuantizedInverseDynamics, VariationalInverseDynamics
from torchrl_koap.modules.baselines.networks import NonlinearInverseDynamics, SupervisedInverseDynamics
from torchrl_koap.modules.baselines.regression import LinearInverseDynamics, PrincipalInverseDynamics
from torchrl_koap.modules.execution.agent import Agent
from torchrl_koap.modules.execution.asynchronous import AsynchronousAgent
from torchrl_koap.modules.execution.execution import Execution, ExecutionConfig
from torchrl_koap.modules.execution.factory import make_policy
from torchrl_koap.modules.execution.followers import blend_plan
from torchrl_koap.modules.execution.mpc import MPC, ResponseModel
from torchrl_koap.modules.execution.policy import PlanningPolicy
from torchrl_koap.modules.execution.policy_env import PolicyEnv, policy_transforms
from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.koopman.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.modules.koopman.latent_action import (
    FourierKernel,
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LatentActionModule,
    LinearActionDecoder,
)
from torchrl_koap.modules.koopman.lifting import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.koopman.presets import PRESETS, make_koopman_inverse_dynamics
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.denoisers import MLPDenoiser
from torchrl_koap.modules.planning.diffusion_policy import DiffusionPolicy
from torchrl_koap.modules.planning.object_denoiser import ObjectColumns, ObjectDenoiser
from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.unet import TemporalUnet
from torchrl_koap.modules.ridge import RidgeFit, ridge
from torchrl_koap.modules.windows import WindowReader

__all__ = [
    "MPC",
    "PRESETS",
    "Agent",
    "AsynchronousAgent",
    "DiffusionPolicy",
    "Execution",
    "ExecutionConfig",
    "FourierKernel",
    "InverseDynamics",
    "KoopmanInverseDynamics",
    "KoopmanLifting",
    "KoopmanOperator",
    "LatentActionFourier",
    "LatentActionLSTM",
    "LatentActionMLP",
    "LatentActionModule",
    "LinearActionDecoder",
    "LinearInverseDynamics",
    "MLPDenoiser",
    "NonlinearInverseDynamics",
    "Normalizer",
    "ObjectColumns",
    "ObjectDenoiser",
    "PlanningPolicy",
    "PolicyEnv",
    "PrincipalInverseDynamics",
    "QuantizedInverseDynamics",
    "ResponseModel",
    "RidgeFit",
    "StatePlanner",
    "SupervisedInverseDynamics",
    "TemporalUnet",
    "VariationalInverseDynamics",
    "WindowReader",
    "blend_plan",
    "make_koopman_inverse_dynamics",
    "make_policy",
    "policy_transforms",
    "ridge",
]
