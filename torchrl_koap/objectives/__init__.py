# This source code is licensed under the MIT license found in the LICENSE file.
"""Loss modules."""

from torchrl_koap.objectives.denoising import DenoisingLoss, DiffusionPolicyLoss, PlannerLoss
from torchrl_koap.objectives.koopman import (
    KOAPLoss,
    KoopmanDynamicsLoss,
    KoopmanReconstructionLoss,
    LatentActionLoss,
)
from torchrl_koap.objectives.latent_decoder import LatentDecoderLoss
from torchrl_koap.objectives.nonlinear import NonlinearLoss
from torchrl_koap.objectives.quantized import QuantizedDynamicsLoss
from torchrl_koap.objectives.supervised import InverseDynamicsLoss
from torchrl_koap.objectives.variational import VariationalLoss

__all__ = [
    "DenoisingLoss",
    "DiffusionPolicyLoss",
    "InverseDynamicsLoss",
    "KOAPLoss",
    "KoopmanDynamicsLoss",
    "KoopmanReconstructionLoss",
    "LatentActionLoss",
    "LatentDecoderLoss",
    "NonlinearLoss",
    "PlannerLoss",
    "QuantizedDynamicsLoss",
    "VariationalLoss",
]
