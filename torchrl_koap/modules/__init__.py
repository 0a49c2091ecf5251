# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks as TensorDictModules: planner, lifting, latent actions, decoder, policies."""

from torchrl_koap.modules.baselines.linear import LinearInverseDynamics
from torchrl_koap.modules.baselines.nonlinear import NonlinearInverseDynamics
from torchrl_koap.modules.baselines.principal import PrincipalInverseDynamics
from torchrl_koap.modules.baselines.quantized import FiniteScalarQuantizer, QuantizedInverseDynamics
from torchrl_koap.modules.baselines.supervised import SupervisedInverseDynamics
from torchrl_koap.modules.baselines.variational import VariationalInverseDynamics
from torchrl_koap.modules.execution.action_chunks import ChunkedPolicy
from torchrl_koap.modules.execution.agent import Agent
from torchrl_koap.modules.execution.asynchronous import AsynchronousAgent
from torchrl_koap.modules.execution.command_leash import CommandLeash
from torchrl_koap.modules.execution.execution import Execution, ExecutionConfig
from torchrl_koap.modules.execution.plan_then_control import PlanThenControl, blend_plan
from torchrl_koap.modules.execution.policy_env import PolicyEnv, SeededNoise
from torchrl_koap.modules.execution.posture_tracking import PostureTracking
from torchrl_koap.modules.execution.predictive_tracking import PredictiveTracking
from torchrl_koap.modules.execution.receding_horizon import RecedingHorizonPolicy, policy_transforms
from torchrl_koap.modules.execution.replay import EpisodeNoise, RecordedFutures, RecordedPlanner
from torchrl_koap.modules.inverse_dynamics import InverseDynamics, LatentInverseDynamics
from torchrl_koap.modules.koopman.action_decoder import LinearActionDecoder
from torchrl_koap.modules.koopman.command_posture import CommandPosture
from torchrl_koap.modules.koopman.command_response import CommandResponse
from torchrl_koap.modules.koopman.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.modules.koopman.latent_action import (
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LatentActionModule,
)
from torchrl_koap.modules.koopman.lifting import KoopmanLifting
from torchrl_koap.modules.koopman.operator import KoopmanOperator
from torchrl_koap.modules.koopman.presets import PRESETS, make_koopman_inverse_dynamics
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.denoisers import MLPDenoiser
from torchrl_koap.modules.planning.diffusion_policy import DiffusionPolicy
from torchrl_koap.modules.planning.noise_schedule import NoiseSchedule
from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.unet import TemporalUnet
from torchrl_koap.modules.ridge import RidgeFit, ridge
from torchrl_koap.modules.windows import WindowReader

__all__ = [
    "PRESETS",
    "Agent",
    "AsynchronousAgent",
    "ChunkedPolicy",
    "CommandLeash",
    "CommandPosture",
    "CommandResponse",
    "DiffusionPolicy",
    "EpisodeNoise",
    "Execution",
    "ExecutionConfig",
    "FiniteScalarQuantizer",
    "InverseDynamics",
    "KoopmanInverseDynamics",
    "KoopmanLifting",
    "KoopmanOperator",
    "LatentActionFourier",
    "LatentActionLSTM",
    "LatentActionMLP",
    "LatentActionModule",
    "LatentInverseDynamics",
    "LinearActionDecoder",
    "LinearInverseDynamics",
    "MLPDenoiser",
    "NoiseSchedule",
    "NonlinearInverseDynamics",
    "Normalizer",
    "PlanThenControl",
    "PolicyEnv",
    "PostureTracking",
    "PredictiveTracking",
    "PrincipalInverseDynamics",
    "QuantizedInverseDynamics",
    "RecedingHorizonPolicy",
    "RecordedFutures",
    "RecordedPlanner",
    "RidgeFit",
    "SeededNoise",
    "StatePlanner",
    "SupervisedInverseDynamics",
    "TemporalUnet",
    "VariationalInverseDynamics",
    "WindowReader",
    "blend_plan",
    "make_koopman_inverse_dynamics",
    "policy_transforms",
    "ridge",
]
