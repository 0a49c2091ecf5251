# This source code is licensed under the MIT license found in the LICENSE file.
"""The planner's default denoiser: a small one-dimensional U-Net over the steps of a plan."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_koap.modules.planning.denoisers import ConditionEncoder, StepEmbedding, check_input


class TemporalUnet(nn.Module):
    """One-dimensional U-Net over the steps of a plan, conditioned by FiLM (Janner et al. 2022; Chi et al. 2023).

    Each block is convolution, group norm, activation, twice, with a residual path; between them the features are
    scaled and shifted per channel by a linear function of the step embedding and the condition. Every level but the
    last halves the number of steps; plans of any horizon are padded at the end by repeating the last step, and cut
    again.

    Speed on a CPU (one core): ``nn.Conv1d`` reaches 90 % of the matrix-product rate from 64 channels on and beats
    unfolding; group norm costs as much as layer norm, but its gradient ten times that on fewer than 8 steps, hence
    the padding.

    Args:
        state_dim (int): number ``d`` of state columns.
        condition_dim (int): number ``c`` of condition columns.
        channels (sequence of int): channels per level. Defaults to ``(32, 64)``.
        kernel_size (int): odd width of the convolutions in steps. Defaults to 5.
        blocks_per_level (int): residual blocks per level on either side. Defaults to 1.
        embedding_dim (int): width of the step embedding. Defaults to 32.
        condition_width (int): width of the :class:`ConditionEncoder`. Defaults to 128.
        frequencies (int): octaves of its Fourier features. Defaults to 4.
        groups (int): groups of the group norm; must divide every entry of ``channels``. Defaults to 8.

    Raises:
        ValueError: if a size is not possible; the message names the argument.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.planning.unet import TemporalUnet
        >>> unet = TemporalUnet(state_dim=2, condition_dim=4)
        >>> unet(torch.randn(3, 14, 2), torch.zeros(3), torch.randn(3, 4)).shape
        torch.Size([3, 14, 2])
    """

    def __init__(
        self,
        state_dim: int,
        condition_dim: int,
        *,
        channels: Sequence[int] = (32, 64),
        kernel_size: int = 5,
        blocks_per_level: int = 1,
        embedding_dim: int = 32,
        condition_width: int = 128,
        frequencies: int = 4,
        groups: int = 8,
    ):
        super().__init__()
        channels = tuple(channels)
        if not channels or any(width < 1 or width % groups for width in channels):
            raise ValueError(f"channels must be multiples of groups ({groups}), got {channels}")
        if kernel_size < 1 or kernel_size % 2 == 0:
            raise ValueError(f"kernel_size must be odd, got {kernel_size}")
        if blocks_per_level < 1:
            raise ValueError(f"blocks_per_level must be at least 1, got {blocks_per_level}")
        self.state_dim, self.condition_dim = state_dim, condition_dim
        self.multiple = max(8, 2 ** (len(channels) - 1))  # steps that plans are padded to a multiple of
        self.step_embedding = StepEmbedding(embedding_dim)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=condition_width)

        def blocks(width_in: int, width_out: int) -> nn.ModuleList:
            widths = [width_in] + [width_out] * blocks_per_level
            return nn.ModuleList(
                _Block(a, b, kernel_size, groups) for a, b in zip(widths[:-1], widths[1:], strict=True)
            )

        levels = list(zip((state_dim, *channels[:-1]), channels, strict=True))
        self.down = nn.ModuleList(blocks(*level) for level in levels)
        self.shrink = nn.ModuleList(nn.Conv1d(width, width, 3, stride=2, padding=1) for width in channels[:-1])
        self.middle = blocks(channels[-1], channels[-1])
        self.up = nn.ModuleList(blocks(2 * width_out, width_in) for width_in, width_out in reversed(levels[1:]))
        self.grow = nn.ModuleList(
            nn.ConvTranspose1d(width, width, 4, stride=2, padding=1) for width in reversed(channels[:-1])
        )
        self.head = nn.Sequential(
            nn.Conv1d(channels[0], channels[0], kernel_size, padding=kernel_size // 2),
            nn.GroupNorm(groups, channels[0]),
            nn.SiLU(),
            nn.Conv1d(channels[0], state_dim, 1),
        )
        # One matrix product serves the FiLM of all blocks: at batch 1 the number of calls is what costs.
        self._film_sizes = [2 * block.width for block in self._all_blocks()]
        self.film = nn.Sequential(nn.SiLU(), nn.Linear(embedding_dim + condition_width, sum(self._film_sizes)))

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
        horizon, batch = sequence.shape[-2], sequence.shape[:-2]
        x = sequence.reshape(-1, horizon, self.state_dim).transpose(1, 2).contiguous()  # [N, d, H]
        condition = self.encoder(condition.reshape(-1, self.condition_dim))
        surplus = -horizon % self.multiple
        if surplus:
            x = F.pad(x, (0, surplus), mode="replicate")
        film = self.film(torch.cat([self.step_embedding(time.reshape(-1)), condition], -1))
        films = iter(film.unsqueeze(-1).split(self._film_sizes, 1))

        kept = []
        for level, blocks in enumerate(self.down):
            for block in blocks:
                x = block(x, next(films))
            kept.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
        for block in self.middle:
            x = block(x, next(films))
        for blocks, grow in zip(self.up, self.grow, strict=True):
            x = torch.cat([x, kept.pop()], 1)
            for block in blocks:
                x = block(x, next(films))
            x = grow(x)
        x = self.head(x)
        return x[..., :horizon].transpose(1, 2).reshape(*batch, horizon, self.state_dim)

    def _all_blocks(self):
        for stage in (self.down, [self.middle], self.up):
            for blocks in stage:
                yield from blocks


class _Block(nn.Module):
    """Two convolutions with a FiLM between them and a residual path around them."""

    def __init__(self, width_in: int, width: int, kernel_size: int, groups: int):
        super().__init__()
        self.width = width
        padding = kernel_size // 2
        self.first = nn.Conv1d(width_in, width, kernel_size, padding=padding)
        self.first_norm = nn.GroupNorm(groups, width)
        self.second = nn.Conv1d(width, width, kernel_size, padding=padding)
        self.second_norm = nn.GroupNorm(groups, width)
        self.shortcut = nn.Conv1d(width_in, width, 1) if width_in != width else nn.Identity()
        self.activation = nn.SiLU()

    def forward(self, x: Tensor, film: Tensor) -> Tensor:
        scale, shift = film.chunk(2, 1)  # [N, width, 1] each
        hidden = self.activation(self.first_norm(self.first(x)))
        hidden = torch.addcmul(hidden + shift, hidden, scale)
        return self.activation(self.second_norm(self.second(hidden))) + self.shortcut(x)
