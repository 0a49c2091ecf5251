# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks as TensorDictModules: planner, lifting, latent actions, decoder, policies."""

from torchrl_koap.modules.baselines.finite_scalar_quantization import FiniteScalarQuantizer
from torchrl_koap.modules.baselines.linear import LinearInverseDynamics
from torchrl_koap.modules.baselines.nonlinear import NonlinearInverseDynamics
from torchrl_koap.modules.baselines.principal import PrincipalInverseDynamics
from torchrl_koap.modules.baselines.quantized import QuantizedInverseDynamics
from torchrl_koap.modules.baselines.supervised import RecurrentInverseDynamics, SupervisedInverseDynamics
from torchrl_koap.modules.baselines.variational import VariationalInverseDynamics
from torchrl_koap.modules.baselines.window_variational import WindowVariationalInverseDynamics
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
from torchrl_koap.modules.koopman.action_decoder import LinearActionDecoder, RidgeFit
from torchrl_koap.modules.koopman.command_posture import CommandPosture
from torchrl_koap.modules.koopman.command_response import CommandResponse
from torchrl_koap.modules.koopman.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.modules.koopman.latent_action import (
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LatentActionModule,
)
from torchrl_koap.modules.koopman.lifting import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.koopman.presets import PRESETS, make_koopman_inverse_dynamics
from torchrl_koap.modules.normalizer import Normalizer
from torchrl_koap.modules.planning.denoisers import MLPDenoiser
from torchrl_koap.modules.planning.diffusion_policy import DiffusionPolicy
from torchrl_koap.modules.planning.noise_schedule import NoiseSchedule
from torchrl_koap.modules.planning.planner import StatePlanner
from torchrl_koap.modules.planning.unet import TemporalUnet
from torchrl_koap.modules.time_alignment import FrameGatherer

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
    "FrameGatherer",
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
    "RecurrentInverseDynamics",
    "RidgeFit",
    "SeededNoise",
    "StatePlanner",
    "SupervisedInverseDynamics",
    "TemporalUnet",
    "VariationalInverseDynamics",
    "WindowVariationalInverseDynamics",
    "blend_plan",
    "make_koopman_inverse_dynamics",
    "policy_transforms",
]
