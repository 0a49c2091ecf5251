# This source code is licensed under the MIT license found in the LICENSE file.
"""Loss modules."""

from torchrl_koap.objectives.baselines import ActionLoss, QuantizedDynamicsLoss, VariationalLoss
from torchrl_koap.objectives.denoising import DiffusionPolicyLoss, PlannerLoss
from torchrl_koap.objectives.koap import KOAPLoss, KoopmanDynamicsLoss, KoopmanReconstructionLoss, LatentActionLoss

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
