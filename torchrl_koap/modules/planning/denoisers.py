# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks that predict the clean sequence (or the noise) in a noisy sequence of states.

All take a sequence ``[*B, H, d]``, a time ``[*B]`` in training steps and a condition ``[*B, c]``, and return
``[*B, H, d]``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


def check_input(sequence: Tensor, condition: Tensor, state_dim: int, condition_dim: int) -> None:
    """Checks that sequence and condition fit a denoiser.

    Args:
        sequence (Tensor): ``[*B, H, state_dim]``.
        condition (Tensor): ``[*B, condition_dim]``.
        state_dim (int): columns of a sequence.
        condition_dim (int): columns of a condition.

    Raises:
        ValueError: if they do not; the message names the axis.
    """
    if sequence.ndim < 2 or sequence.shape[-1] != state_dim:
        raise ValueError(f"sequence must be [*B, H, {state_dim}] (state_dim), got {list(sequence.shape)}")
    if condition.shape != (*sequence.shape[:-2], condition_dim):
        wanted = [*sequence.shape[:-2], condition_dim]
        raise ValueError(f"condition must be {wanted} ([*B, condition_dim]), got {list(condition.shape)}")


class StepEmbedding(nn.Module):
    """Embeds times as sines and cosines of geometrically spaced frequencies, then a two-layer network.

    Args:
        embedding_dim (int): width of the embedding, even and at least 4.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.planning.denoisers import StepEmbedding
        >>> StepEmbedding(32)(torch.arange(5.0)).shape
        torch.Size([5, 32])
    """

    def __init__(self, embedding_dim: int):
        super().__init__()
        if embedding_dim < 4 or embedding_dim % 2:
            raise ValueError(f"embedding_dim must be even and at least 4, got {embedding_dim}")
        half = embedding_dim // 2
        self.register_buffer("frequencies", torch.exp(torch.arange(half) * (-math.log(10000.0) / (half - 1))))
        self.network = nn.Sequential(
            nn.Linear(embedding_dim, 4 * embedding_dim),
            nn.SiLU(),
            nn.Linear(4 * embedding_dim, embedding_dim),
        )

    def forward(self, time: Tensor) -> Tensor:
        """Time ``[B]`` to embedding ``[B, embedding_dim]``."""
        angles = time[:, None] * self.frequencies
        return self.network(torch.cat([angles.sin(), angles.cos()], -1))


class ConditionEncoder(nn.Module):
    """Embeds a condition with entries of order one: Fourier features (Tancik et al. 2020), then a two-layer network.

    Where to pass an obstacle changes within centimetres; sines of up to ``2^(frequencies - 1)`` half turns per unit
    let a small network learn such edges in a fraction of the steps.

    Args:
        condition_dim (int): number ``c`` of condition columns.
        frequencies (int): octaves of sines and cosines per column; 0 leaves the plain columns.
        width (int): width of the embedding.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.planning.denoisers import ConditionEncoder
        >>> ConditionEncoder(4, frequencies=3, width=64)(torch.randn(5, 4)).shape
        torch.Size([5, 64])
    """

    def __init__(self, condition_dim: int, *, frequencies: int, width: int):
        super().__init__()
        self.register_buffer("frequencies", math.pi * 2.0 ** torch.arange(frequencies))
        self.network = nn.Sequential(
            nn.Linear(condition_dim * (1 + 2 * frequencies), width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, condition: Tensor) -> Tensor:
        """Condition ``[B, c]`` to embedding ``[B, width]``."""
        angles = (condition[:, :, None] * self.frequencies).flatten(1)
        return self.network(torch.cat([condition, angles.sin(), angles.cos()], -1))


class MLPDenoiser(nn.Module):
    """Residual network on the flattened sequence, for one fixed horizon: what planners of tasks with objects have.

    On Avoiding its plans touch obstacles more often than those of
    :class:`~torchrl_koap.modules.planning.unet.TemporalUnet`.

    Args:
        state_dim (int): number ``d`` of state columns.
        condition_dim (int): number ``c`` of condition columns.
        horizon (int): number ``H`` of planned steps.
        width (int): hidden width. Defaults to 512.
        depth (int): number of residual layers. Defaults to 4.
        embedding_dim (int): width of the step embedding. Defaults to 32.
        frequencies (int): octaves of the condition's Fourier features. Defaults to 1.

    Raises:
        ValueError: for an ``embedding_dim`` that is odd or below 4.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.planning.denoisers import MLPDenoiser
        >>> network = MLPDenoiser(state_dim=2, condition_dim=4, horizon=14)
        >>> network(torch.randn(3, 14, 2), torch.zeros(3), torch.randn(3, 4)).shape
        torch.Size([3, 14, 2])
    """

    def __init__(
        self,
        state_dim: int,
        condition_dim: int,
        *,
        horizon: int,
        width: int = 512,
        depth: int = 4,
        embedding_dim: int = 32,
        frequencies: int = 1,
    ):
        super().__init__()
        self.state_dim, self.condition_dim, self.horizon = state_dim, condition_dim, horizon
        self.step_embedding = StepEmbedding(embedding_dim)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=width)
        self.first = nn.Linear(horizon * state_dim + width + embedding_dim, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(depth)
        )
        self.last = nn.Linear(width, horizon * state_dim)

    def forward(self, sequence: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """Predicts what the schedule asks for, from noisy sequences.

        Args:
            sequence (Tensor): noisy sequences ``[*B, H, d]``.
            time (Tensor): ``[*B]`` in training steps.
            condition (Tensor): ``[*B, c]``.

        Returns:
            Tensor: the prediction ``[*B, H, d]``.

        Raises:
            ValueError: for a sequence or condition of another shape.
        """
        check_input(sequence, condition, self.state_dim, self.condition_dim)
        if sequence.shape[-2] != self.horizon:
            raise ValueError(f"sequence must have {self.horizon} steps (horizon) on axis -2, got {sequence.shape[-2]}")
        x = sequence.reshape(-1, self.horizon * self.state_dim)
        condition = self.encoder(condition.reshape(-1, self.condition_dim))
        context = torch.cat([condition, self.step_embedding(time.reshape(-1))], -1)
        x = self.first(torch.cat([x, context], -1))
        for layer in self.layers:
            x = x + layer(x)
        return self.last(x).reshape(sequence.shape)
