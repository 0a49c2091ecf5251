# This source code is licensed under the MIT license found in the LICENSE file.
"""A small one-dimensional U-Net over the steps of a plan; the default if a task with an environment names no other."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchrl_koap.modules.planning.denoisers import EMBEDDING_DIM, ConditionEncoder, Denoiser

KERNEL, GROUPS = 5, 8  # width of the convolutions in steps; groups of the group norm
CONDITION = 128  # width of the embedded condition


class TemporalUnet(Denoiser):
    """One-dimensional U-Net over the steps of a plan, conditioned by FiLM (Janner et al. 2022; Chi et al. 2023).

    Each block is twice a convolution, group norm and activation, with a residual path. In between, a linear function of
    the step embedding and the condition scales and shifts every channel. Every level but the last halves the number of
    steps. Plans of any horizon are padded by repeating the last step, and truncated at the end.

    Args and errors as for :class:`~torchrl_koap.modules.planning.denoisers.Denoiser`.

    Keyword Args:
        channels (sequence of int): channels per level, multiples of 8. Defaults to ``(32, 64)``.
        frequencies (int): octaves of the condition's Fourier features. Defaults to 4.

    Raises:
        ValueError: for channels that are not multiples of 8.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.planning.unet import TemporalUnet
        >>> unet = TemporalUnet(state_dim=2, condition_dim=4)
        >>> unet(torch.randn(3, 14, 2), torch.zeros(3), torch.randn(3, 4)).shape
        torch.Size([3, 14, 2])
    """

    def __init__(self, state_dim: int, condition_dim: int, *, channels: Sequence[int] = (32, 64), frequencies: int = 4):
        super().__init__(state_dim, condition_dim)
        self.encoder = ConditionEncoder(condition_dim, frequencies=frequencies, width=CONDITION)
        channels = tuple(channels)
        if not channels or any(width < 1 or width % GROUPS for width in channels):
            raise ValueError(f"channels must be multiples of {GROUPS}, got {channels}")
        # plans are padded to a multiple of this many steps: the gradient of group norm is slow on fewer than 8
        self.multiple = max(8, 2 ** (len(channels) - 1))

        def block(width_in: int, width_out: int) -> nn.ModuleList:
            return nn.ModuleList([_Block(width_in, width_out)])  # a list, since pretrained weights have its names

        levels = list(zip((state_dim, *channels[:-1]), channels, strict=True))
        self.down = nn.ModuleList(block(*level) for level in levels)
        self.shrink = nn.ModuleList(nn.Conv1d(width, width, 3, stride=2, padding=1) for width in channels[:-1])
        self.middle = block(channels[-1], channels[-1])
        self.up = nn.ModuleList(block(2 * width_out, width_in) for width_in, width_out in reversed(levels[1:]))
        self.grow = nn.ModuleList(
            nn.ConvTranspose1d(width, width, 4, stride=2, padding=1) for width in reversed(channels[:-1])
        )
        self.head = nn.Sequential(
            nn.Conv1d(channels[0], channels[0], KERNEL, padding=KERNEL // 2),
            nn.GroupNorm(GROUPS, channels[0]),
            nn.SiLU(),
            nn.Conv1d(channels[0], state_dim, 1),
        )
        # One matrix product serves the FiLM of all blocks: at batch size 1 the number of calls determines the time.
        self._film_sizes = [2 * stage.width for (stage,) in (*self.down, self.middle, *self.up)]
        self.film = nn.Sequential(nn.SiLU(), nn.Linear(EMBEDDING_DIM + CONDITION, sum(self._film_sizes)))

    def denoise(self, x: Tensor, step: Tensor, condition: Tensor) -> Tensor:
        """Predicts ``[N, H, d]`` from sequences ``[N, H, d]`` (:meth:`Denoiser.denoise`)."""
        horizon = x.shape[1]
        x = x.transpose(1, 2).contiguous()  # [N, d, H]
        surplus = -horizon % self.multiple
        if surplus:
            x = F.pad(x, (0, surplus), mode="replicate")
        film = self.film(torch.cat([step, self.encoder(condition)], -1))
        films = iter(film.unsqueeze(-1).split(self._film_sizes, 1))

        kept = []
        for level, (block,) in enumerate(self.down):
            x = block(x, next(films))
            kept.append(x)
            if level < len(self.shrink):
                x = self.shrink[level](x)
        x = self.middle[0](x, next(films))
        for (block,), grow in zip(self.up, self.grow, strict=True):
            x = grow(block(torch.cat([x, kept.pop()], 1), next(films)))
        return self.head(x)[..., :horizon].transpose(1, 2)


class _Block(nn.Module):
    """Two convolutions with a FiLM between them and a residual path around them."""

    def __init__(self, width_in: int, width: int):
        super().__init__()
        self.width = width
        self.first = nn.Conv1d(width_in, width, KERNEL, padding=KERNEL // 2)
        self.first_norm = nn.GroupNorm(GROUPS, width)
        self.second = nn.Conv1d(width, width, KERNEL, padding=KERNEL // 2)
        self.second_norm = nn.GroupNorm(GROUPS, width)
        self.shortcut = nn.Conv1d(width_in, width, 1) if width_in != width else nn.Identity()
        self.activation = nn.SiLU()

    def forward(self, x: Tensor, film: Tensor) -> Tensor:
        scale, shift = film.chunk(2, 1)  # [N, width, 1] each
        hidden = self.activation(self.first_norm(self.first(x)))
        hidden = torch.addcmul(hidden + shift, hidden, scale)
        return self.activation(self.second_norm(self.second(hidden))) + self.shortcut(x)
