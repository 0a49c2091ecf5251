# This source code is licensed under the MIT license found in the LICENSE file.
"""What a controller reads that may look at ``x_{t+1}``: the present state and the steps around it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_koap.modules.time_alignment import check_offsets, frame_index


class TransitionFrames(nn.Module):
    """Gathers ``x_t`` and the steps between the frames around it, each step divided by its own spread.

    ``x_{t-n+1} - x_{t-n}, ..., x_t - x_{t-1}, x_t, x_{t+k_1} - x_t, x_{t+k_2} - x_{t+k_1}, ...``: the input of
    :class:`~torchrl_koap.modules.koopman.latent_action.LatentActionModule` with ``relative=True``, except that the
    successor ``x_{t+1}`` is allowed, which a Koopman model has to predict and other inverse models are given.

    Args:
        state_dim (int): size ``d`` of a state.

    Keyword Args:
        history (int): number ``n`` of frames before the current one.
        look_ahead (int or sequence of int): offsets ``k >= 1``.

    Raises:
        ValueError: for a negative history or an offset below 1; at the call for states of another size.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules.transition_frames import TransitionFrames
        >>> frames = TransitionFrames(1, history=1, look_ahead=(1, 3))
        >>> frames(torch.arange(6.0).square()[:, None])[2].tolist()  # 4 - 1, 4, 9 - 4, 25 - 9
        [3.0, 4.0, 5.0, 16.0]
        >>> frames.span(6)
        range(1, 3)
    """

    scales: Tensor

    def __init__(self, state_dim: int, *, history: int = 4, look_ahead: int | Sequence[int] = (1, 2, 3, 4, 5)):
        super().__init__()
        self.state_dim, self.history = state_dim, history
        self.look_ahead = check_offsets(history, look_ahead, least=1)
        self.num_frames = history + 1 + len(self.look_ahead)
        self.register_buffer("scales", torch.ones(self.num_frames, state_dim))

    @property
    def num_features(self) -> int:
        """Size of what is read."""
        return self.num_frames * self.state_dim

    @property
    def num_window_frames(self) -> int:
        """Frames of the shortest window in which a frame (``history``) has all it reads."""
        return self.history + 1 + self.look_ahead[-1]

    def span(self, num_frames: int) -> range:
        """Frames of a window of ``num_frames`` that have all they read inside it.

        Raises:
            ValueError: if there is none.
        """
        if num_frames < self.num_window_frames:
            raise ValueError(
                f"a window of {num_frames} frames is too short for history {self.history} and look-ahead"
                f" {self.look_ahead}: at least {self.num_window_frames} frames are needed"
            )
        return range(self.history, num_frames - self.look_ahead[-1])

    def forward(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What every frame of a window, or some of its ``frames``, reads.

        Args:
            state (Tensor): states ``[*B, T, d]``.
            frames (range, optional): frames to read for. Default: all; offsets beyond the window are clamped to it.

        Returns:
            Tensor: ``[*B, len(frames), num_features]``.
        """
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"expected states with {self.state_dim} columns, got shape {list(state.shape)}")
        num_frames, n = state.shape[-2], self.history
        frames = range(num_frames) if frames is None else frames
        read = state[..., frame_index(frames, num_frames, n, self.look_ahead, state.device), :]  # [*B, T, F, d]
        steps = read[..., 1:, :] - read[..., :-1, :]
        return (torch.cat([steps[..., :n, :], read[..., n : n + 1, :], steps[..., n:, :]], -2) / self.scales).flatten(
            -2
        )

    @torch.no_grad()
    def fit_scales(self, windows: Tensor) -> None:
        """Sets the spread (root mean square) of every step from windows ``[*B, T, d]``; no label is read."""
        read = self(windows, self.span(windows.shape[-2])).unflatten(-1, self.scales.shape)
        spread = read.flatten(0, -3).square().mean(0).sqrt() * self.scales
        spread[self.history] = 1.0  # the current frame stays in the normaliser's units
        self.scales.copy_(torch.where(spread > 1e-9, spread, torch.ones_like(spread)))
