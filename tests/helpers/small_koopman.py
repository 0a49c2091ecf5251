# This source code is licensed under the MIT license found in the LICENSE file.
"""Small Koopman inverse dynamics and batches of partially labelled windows, for the losses."""

from __future__ import annotations

import torch
from inverse_dynamics_test_base import normalizers
from tensordict import TensorDict

from torchrl_koap.modules import (
    KoopmanInverseDynamics,
    KoopmanLifting,
    KoopmanOperator,
    LatentActionFourier,
    LatentActionLSTM,
    LatentActionMLP,
    LinearActionDecoder,
)
from torchrl_koap.objectives import KOAPLoss, KoopmanDynamicsLoss, KoopmanReconstructionLoss, LatentActionLoss

T, K, HISTORY = 9, 3, 1
LOSSES = (KoopmanReconstructionLoss, KoopmanDynamicsLoss, LatentActionLoss, KOAPLoss)
NETWORKS = ("mlp", "lstm", "fourier")


def make_network(kind="mlp", *, clamped=False, seed=0):
    torch.manual_seed(seed)
    frames = {"num_past": HISTORY, "look_ahead": K, "clamped": clamped}
    if kind == "mlp":
        latent_action = LatentActionMLP(3, 4, hidden_dims=(16,), **frames)
    elif kind == "lstm":
        latent_action = LatentActionLSTM(3, 4, hidden_dim=8, **frames)
    else:
        latent_action = LatentActionFourier(3, 16, **frames)
    operator = KoopmanOperator(4, input_dim=latent_action.latent_dim if kind == "fourier" else None)
    if kind == "fourier":
        torch.nn.init.normal_(operator.input, std=0.1)
    return KoopmanInverseDynamics(
        latent_action,
        LinearActionDecoder(latent_action.latent_dim, 2),
        lifting=KoopmanLifting(3, 4, hidden_dims=(16,), include_state=kind == "fourier"),
        operator=operator,
        **normalizers(),
    )


def make_batch(*batch, dtype=torch.float32, share=0.5, num_frames=T):
    generator = torch.Generator().manual_seed(4)
    state = torch.randn(*batch, num_frames, 3, generator=generator, dtype=torch.float64).cumsum(-2)
    action = torch.randn(*batch, num_frames, 2, generator=generator, dtype=torch.float64)
    has_action = torch.rand(*batch, num_frames, 1, generator=generator) < share
    action = torch.where(has_action, action, torch.nan)
    return TensorDict({"state": state.to(dtype), "action": action.to(dtype), "has_action": has_action}, batch)
