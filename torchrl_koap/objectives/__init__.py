# This source code is licensed under the MIT license found in the LICENSE file.
"""Loss modules."""

from torchrl_koap.objectives.action import ActionLoss
from torchrl_koap.objectives.denoising import DiffusionPolicyLoss, PlannerLoss
from torchrl_koap.objectives.koap import (
    KOAPLoss,
    KoopmanDynamicsLoss,
    KoopmanReconstructionLoss,
    LatentActionLoss,
)
from torchrl_koap.objectives.latents import QuantizedDynamicsLoss, VariationalLoss

__all__ = [
    "ActionLoss",
    "DiffusionPolicyLoss",
    "KOAPLoss",
    "KoopmanDynamicsLoss",
    "KoopmanReconstructionLoss",
    "LatentActionLoss",
    "PlannerLoss",
    "QuantizedDynamicsLoss",
    "VariationalLoss",
]
