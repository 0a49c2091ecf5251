# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks that predict the noise (or the clean plan, or the velocity) in a noisy sequence of states.

All take a sequence ``[*B, H, d]``, a time ``[*B]`` in training steps and a condition ``[*B, c]``, and return
``[*B, H, d]``.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_koap.lookup import lookup

ACTIVATIONS = {"silu": nn.SiLU, "mish": nn.Mish, "gelu": nn.GELU, "relu": nn.ReLU}


def check_activation(name: str) -> None:
    """Raises a ``ValueError`` for a name that is not in ``ACTIVATIONS``."""
    lookup(ACTIVATIONS, name, "activation")


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
        activation (str): a name in ``ACTIVATIONS``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.denoisers import StepEmbedding
        >>> StepEmbedding(32)(torch.arange(5.0)).shape
        torch.Size([5, 32])
    """

    def __init__(self, embedding_dim: int, activation: str = "silu"):
        super().__init__()
        if embedding_dim < 4 or embedding_dim % 2:
            raise ValueError(f"embedding_dim must be even and at least 4, got {embedding_dim}")
        half = embedding_dim // 2
        self.register_buffer("frequencies", torch.exp(torch.arange(half) * (-math.log(10000.0) / (half - 1))))
        self.network = nn.Sequential(
            nn.Linear(embedding_dim, 4 * embedding_dim),
            ACTIVATIONS[activation](),
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
        activation (str): a name in ``ACTIVATIONS``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.denoisers import ConditionEncoder
        >>> ConditionEncoder(4, frequencies=3, width=64)(torch.randn(5, 4)).shape
        torch.Size([5, 64])
    """

    def __init__(self, condition_dim: int, *, frequencies: int, width: int, activation: str = "silu"):
        super().__init__()
        self.register_buffer("frequencies", math.pi * 2.0 ** torch.arange(frequencies))
        self.network = nn.Sequential(
            nn.Linear(condition_dim * (1 + 2 * frequencies), width), ACTIVATIONS[activation](), nn.Linear(width, width)
        )

    def forward(self, condition: Tensor) -> Tensor:
        """Condition ``[B, c]`` to embedding ``[B, width]``."""
        angles = (condition[:, :, None] * self.frequencies).flatten(1)
        return self.network(torch.cat([condition, angles.sin(), angles.cos()], -1))


class MLPDenoiser(nn.Module):
    """Residual network on the flattened plan: the cheapest denoiser, for one fixed horizon.

    On Avoiding its plans touch obstacles more often than those of
    :class:`~torchrl_koap.modules.diffusion.unet.TemporalUnet`; it serves comparisons and toy problems.

    Args:
        state_dim (int): number ``d`` of state columns.
        condition_dim (int): number ``c`` of condition columns.
        horizon (int): number ``H`` of planned steps.
        width (int): hidden width. Defaults to 256.
        depth (int): number of residual layers. Defaults to 3.
        embedding_dim (int): width of the step embedding. Defaults to 32.
        frequencies (int): octaves of the condition's Fourier features. Defaults to 4.
        dropout (float): share of the hidden units that are dropped in training. Defaults to 0.
        film (bool): also scale and shift the input of every residual layer by a linear function of step embedding and
            condition (Peebles and Xie 2023). Defaults to False: they enter once, beside the plan.

    Raises:
        ValueError: for a dropout outside [0, 1), or an ``embedding_dim`` that is odd or below 4.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.denoisers import MLPDenoiser
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
        width: int = 256,
        depth: int = 3,
        embedding_dim: int = 32,
        frequencies: int = 4,
        dropout: float = 0.0,
        film: bool = False,
    ):
        super().__init__()
        if not 0 <= dropout < 1:
            raise ValueError(f"dropout must be in [0, 1), got {dropout}")
        self.state_dim, self.condition_dim, self.horizon = state_dim, condition_dim, horizon
        self.step_embedding = StepEmbedding(embedding_dim)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=width)
        self.first = nn.Linear(horizon * state_dim + width + embedding_dim, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(depth)
        )
        self.last = nn.Linear(width, horizon * state_dim)
        self.dropout = nn.Dropout(dropout)
        self.film = None
        if film:  # starts as the identity
            self.film = nn.Linear(width + embedding_dim, 2 * depth * width)
            nn.init.zeros_(self.film.weight)
            nn.init.zeros_(self.film.bias)

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
        films = (
            [None] * len(self.layers) if self.film is None else self.film(F.silu(context)).chunk(len(self.layers), -1)
        )
        for layer, film in zip(self.layers, films, strict=True):
            norm, first, activation, second = layer
            hidden = norm(x)
            if film is not None:
                scale, shift = film.chunk(2, -1)
                hidden = torch.addcmul(hidden + shift, hidden, scale)
            x = x + second(self.dropout(activation(first(hidden))))
        return self.last(x).reshape(sequence.shape)


class TransformerDenoiser(nn.Module):
    """Small pre-norm transformer over the steps of a plan, for any horizon.

    Time and condition enter every step's token by addition; positions are encoded by sines and cosines.

    Args:
        state_dim (int): number ``d`` of state columns.
        condition_dim (int): number ``c`` of condition columns.
        width (int): token width. Defaults to 64.
        depth (int): number of layers. Defaults to 3.
        heads (int): attention heads; must divide ``width``. Defaults to 4.
        frequencies (int): octaves of the condition's Fourier features. Defaults to 4.

    Raises:
        ValueError: if ``heads`` does not divide ``width``, or ``width`` is odd.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.diffusion.denoisers import TransformerDenoiser
        >>> network = TransformerDenoiser(state_dim=2, condition_dim=4)
        >>> network(torch.randn(3, 14, 2), torch.zeros(3), torch.randn(3, 4)).shape
        torch.Size([3, 14, 2])
    """

    def __init__(
        self,
        state_dim: int,
        condition_dim: int,
        *,
        width: int = 64,
        depth: int = 3,
        heads: int = 4,
        frequencies: int = 4,
    ):
        super().__init__()
        if width % heads or width % 2:
            raise ValueError(f"width must be even and a multiple of heads ({heads}), got {width}")
        self.state_dim, self.condition_dim = state_dim, condition_dim
        self.step_embedding = StepEmbedding(width)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=width)
        self.first = nn.Linear(state_dim, width)
        self.layers = nn.ModuleList(
            nn.TransformerEncoderLayer(
                width, heads, 4 * width, dropout=0.0, activation=F.silu, batch_first=True, norm_first=True
            )
            for _ in range(depth)
        )
        self.last = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, state_dim))
        half = width // 2
        self.register_buffer("frequencies", torch.exp(torch.arange(half) * (-math.log(100.0) / max(half - 1, 1))))

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
        horizon = sequence.shape[-2]
        angles = torch.arange(horizon, device=sequence.device, dtype=sequence.dtype)[:, None] * self.frequencies
        position = torch.cat([angles.sin(), angles.cos()], -1)  # [H, width]
        context = self.step_embedding(time.reshape(-1)) + self.encoder(condition.reshape(-1, self.condition_dim))
        x = self.first(sequence.reshape(-1, horizon, self.state_dim)) + position + context[:, None]
        for layer in self.layers:
            x = layer(x)
        return self.last(x).reshape(sequence.shape)
