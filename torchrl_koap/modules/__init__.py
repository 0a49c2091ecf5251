# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks as TensorDictModules: planner, lifting, latent actions, decoder, policies."""

from torchrl_koap.modules.action_decoder import LinearActionDecoder, RidgeFit
from torchrl_koap.modules.chunked_policy import ChunkedPolicy
from torchrl_koap.modules.denoisers import MLPDenoiser, TransformerDenoiser
from torchrl_koap.modules.diffusion import NoiseSchedule
from torchrl_koap.modules.diffusion_policy import DiffusionPolicy
from torchrl_koap.modules.finite_scalar_quantization import FiniteScalarQuantizer
from torchrl_koap.modules.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.modules.koopman import KoopmanLifting, KoopmanOperator
from torchrl_koap.modules.latent_action import (
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LatentActionModule,
)
from torchrl_koap.modules.linear import LinearInverseDynamics
from torchrl_koap.modules.nonlinear import NonlinearInverseDynamics
from torchrl_koap.modules.planner import StatePlanner
from torchrl_koap.modules.policies import EpisodeNoise, PlanThenControl, join_plan, policy_transforms
from torchrl_koap.modules.presets import PRESETS, make_koopman_inverse_dynamics
from torchrl_koap.modules.quantized import QuantizedInverseDynamics
from torchrl_koap.modules.supervised import RecurrentInverseDynamics, SupervisedInverseDynamics
from torchrl_koap.modules.unet import TemporalUnet
from torchrl_koap.modules.variational import VariationalInverseDynamics
from torchrl_koap.modules.window_controller import LatentInverseDynamics, WindowController

__all__ = [
    "PRESETS",
    "ChunkedPolicy",
    "DiffusionPolicy",
    "EpisodeNoise",
    "FiniteScalarQuantizer",
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
    "PlanThenControl",
    "QuantizedInverseDynamics",
    "RecurrentInverseDynamics",
    "RidgeFit",
    "StatePlanner",
    "SupervisedInverseDynamics",
    "TemporalUnet",
    "TransformerDenoiser",
    "VariationalInverseDynamics",
    "WindowController",
    "join_plan",
    "make_koopman_inverse_dynamics",
    "policy_transforms",
]
