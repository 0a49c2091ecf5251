# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks that predict clean sequences from noisy ones, and features of their condition."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

EMBEDDING_DIM = 32  # width of the embedding of a step
NEAR = (0.05, 0.015)  # length scales in m of the magnified copies of positions


class StepEmbedding(nn.Module):
    """Embeds times by sines and cosines of geometrically spaced frequencies and a two-layer network."""

    def __init__(self):
        super().__init__()
        half = EMBEDDING_DIM // 2
        self.register_buffer("frequencies", torch.exp(torch.arange(half) * (-math.log(10000.0) / (half - 1))))
        self.network = nn.Sequential(
            nn.Linear(EMBEDDING_DIM, 4 * EMBEDDING_DIM), nn.SiLU(), nn.Linear(4 * EMBEDDING_DIM, EMBEDDING_DIM)
        )

    def forward(self, time: Tensor) -> Tensor:
        """Maps times ``[B]`` to embeddings ``[B, 32]``."""
        angles = time[:, None] * self.frequencies
        return self.network(torch.cat([angles.sin(), angles.cos()], -1))


class ConditionEncoder(nn.Module):
    """Embeds a condition with entries of order one by Fourier features (Tancik et al. 2020) and a two-layer network.

    The side on which to pass an obstacle changes within centimetres. Sines of up to ``2^(frequencies - 1)`` half turns
    per unit let a small network learn such edges in fewer steps. Every one of the ``condition_dim`` columns is used
    unchanged and in ``frequencies`` octaves of sines and cosines; ``width`` is the width of the embedding.
    """

    def __init__(self, condition_dim: int, *, frequencies: int, width: int):
        super().__init__()
        self.register_buffer("frequencies", math.pi * 2.0 ** torch.arange(frequencies))
        self.network = nn.Sequential(
            nn.Linear(condition_dim * (1 + 2 * frequencies), width), nn.SiLU(), nn.Linear(width, width)
        )

    def forward(self, condition: Tensor) -> Tensor:
        """Maps conditions ``[*B, c]`` to embeddings ``[*B, width]``."""
        angles = (condition.unsqueeze(-1) * self.frequencies).flatten(-2)
        return self.network(torch.cat([condition, angles.sin(), angles.cos()], -1))


class Denoiser(nn.Module):
    """Base class of denoisers: checks inputs, flattens batches, embeds the time. A subclass denoises.

    Args:
        state_dim (int): number ``d`` of state columns.
        condition_dim (int): number ``c`` of condition columns.

    Keyword Args:
        horizon (int, optional): number ``H`` of steps that a sequence must have. Default: any.
    """

    def __init__(self, state_dim: int, condition_dim: int, *, horizon: int | None = None):
        super().__init__()
        self.state_dim, self.condition_dim, self.horizon = state_dim, condition_dim, horizon
        self.step_embedding = StepEmbedding()

    def denoise(self, x: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """Predicts ``[N, H, d]`` from sequences ``[N, H, d]``, embedded steps ``[N, 32]`` and conditions ``[N, c]``."""
        raise NotImplementedError

    def forward(self, sequence: Tensor, time: Tensor, condition: Tensor) -> Tensor:
        """Predicts clean sequences from noisy ones ``[*B, H, d]``, given times and conditions.

        Times are ``[*B]`` in training steps, conditions ``[*B, c]``.
        """
        if sequence.ndim < 2 or sequence.shape[-1] != self.state_dim:
            raise ValueError(f"sequence must be [*B, H, {self.state_dim}] (state_dim), got {list(sequence.shape)}")
        if self.horizon not in (None, sequence.shape[-2]):
            raise ValueError(f"sequence must have {self.horizon} steps (horizon) on axis -2, got {sequence.shape[-2]}")
        wanted = (*sequence.shape[:-2], self.condition_dim)
        if condition.shape != wanted:
            raise ValueError(f"condition must be {list(wanted)} ([*B, condition_dim]), got {list(condition.shape)}")
        x, condition = sequence.reshape(-1, *sequence.shape[-2:]), condition.reshape(-1, self.condition_dim)
        clean = self.denoise(x, self.step_embedding(time.reshape(-1)), condition)
        if clean.shape != x.shape:
            raise ValueError(f"denoise() of {type(self).__name__} must give {list(x.shape)}, got {list(clean.shape)}")
        return clean.reshape(sequence.shape)


class MLPDenoiser(Denoiser):
    """Residual network on the flattened sequence, of fixed horizon; default for recorded data.

    On Avoiding, its plans touch obstacles more often than those of
    :class:`~torchrl_koap.modules.planning.unet.TemporalUnet`.

    Args and errors as for :class:`Denoiser`.

    Keyword Args:
        horizon (int): number ``H`` of planned steps.
        width (int): hidden width. Defaults to 512.
        depth (int): number of residual layers. Defaults to 4.
        frequencies (int): octaves of the condition's Fourier features. Defaults to 1.

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
        frequencies: int = 1,
    ):
        super().__init__(state_dim, condition_dim, horizon=horizon)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=width)
        self.first = nn.Linear(horizon * state_dim + width + EMBEDDING_DIM, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(depth)
        )
        self.last = nn.Linear(width, horizon * state_dim)

    def denoise(self, x: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """Predicts ``[N, H d]`` from sequences ``[N, H, d]`` (:meth:`Denoiser.denoise`)."""
        x = self.first(torch.cat([x.flatten(1), self.encoder(condition), step], -1))
        for layer in self.layers:
            x = x + layer(x)
        return self.last(x).unflatten(-1, (-1, self.state_dim))


class RelativePositionFeatures(nn.Module):
    r"""Computes positions relative to objects, plain and magnified near zero (to a millimetre near a contact).

    .. math::
        d = R(-\theta) (p - o), \qquad (d,\; \tanh(d / 0.05\,\mathrm{m}),\; \tanh(d / 0.015\,\mathrm{m}))

    for every position ``p`` and an origin ``o`` with yaw ``theta``; heights are not rotated. Normalised states in world
    coordinates resolve ``d`` only to some per cent of the table's size. The features are part of the condition only;
    plans remain states. Histories of states ``[*B, h, d]`` give ``[*B, num_features]``, from their last frame.

    Args:
        pairs (sequence): state columns of up to four parts each: a position of 2 or 3 columns; the origin, and if it
            has 2 columns the height stays absolute; ``cos, sin`` of the yaw of the frame of reference; ``cos, sin`` of
            a yaw that is also expressed in that frame.
    """

    def __init__(self, pairs: Sequence[Sequence[slice]]):
        super().__init__()
        self.pairs = [(*pair, None, None)[:4] for pair in pairs]

    @property
    def num_features(self) -> int:
        """Number of features."""
        sizes = (place.stop - place.start for place, *_ in self.pairs)
        return sum((1 + len(NEAR)) * size for size in sizes) + sum(2 for *_, turned in self.pairs if turned)

    def forward(self, history: Tensor) -> Tensor:
        """Computes the features of the last frame."""
        state = history[..., -1, :]
        parts = []
        for *positions, yaw, turned in self.pairs:
            place, origin = (state[..., columns] for columns in positions)
            shared = min(place.shape[-1], origin.shape[-1])
            gap = torch.cat([place[..., :shared] - origin[..., :shared], place[..., shared:]], -1)
            if yaw is not None:
                frame = state[..., yaw]
                gap = torch.cat([_turn_back(gap[..., :2], frame), gap[..., 2:]], -1)
                if turned is not None:
                    parts.append(_turn_back(state[..., turned], frame))
            parts += [gap, *(torch.tanh(gap / near) for near in NEAR)]
        return torch.cat(parts, -1)


def _turn_back(vector: Tensor, yaw: Tensor) -> Tensor:
    x, y = vector.unbind(-1)
    cosine, sine = yaw.unbind(-1)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x], -1)
