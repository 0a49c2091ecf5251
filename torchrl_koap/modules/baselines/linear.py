# This source code is licensed under the MIT license found in the LICENSE file.
"""Ridge regression on raw frames: the control that any latent method must beat."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_koap.keys import ACTION, STATE
from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.koopman.action_decoder import INPUT_NOISE, LinearActionDecoder, RidgeFit
from torchrl_koap.modules.time_alignment import check_offsets, frame_index, frame_span


class LinearInverseDynamics(InverseDynamics):
    """Ridge regression from the raw frames ``x_{t-n}, ..., x_t, x_{t+k}`` to the action: no latent action at all.

    The control that any latent method must beat. It reads labelled frames only; there is nothing to train.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        num_past (int): frames before the present one. Defaults to ``1``.
        look_ahead (int or sequence of int): offsets ``k >= 2``, as for KOAP. Defaults to ``8``.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``. Defaults to ``"action"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LinearInverseDynamics
        >>> windows = TensorDict({"state": torch.randn(50, 10, 2)}, [50])
        >>> windows["action"] = windows["state"].roll(-8, 1) - windows["state"]  # x_{t+8} - x_t
        >>> model = LinearInverseDynamics(2, 2)
        >>> fit = model.fit_decoder(windows, torch.ones(50, 10, dtype=torch.bool))
        >>> bool((model(windows.clone())["action"][:, 1] - windows["action"][:, 1]).abs().max() < 1e-3)
        True
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        num_past: int = 1,
        look_ahead: int | Sequence[int] = 8,
        in_key: NestedKey = STATE,
        out_key: NestedKey = ACTION,
    ):
        super().__init__(in_key=in_key, out_key=out_key)
        self._num_past, self.look_ahead = num_past, check_offsets(num_past, look_ahead)
        self.decoder = LinearActionDecoder((num_past + 1 + len(self.look_ahead)) * state_dim, action_dim)
        self.register_buffer("offset", torch.zeros(self.decoder.linear.in_features))
        self.register_buffer("scale", torch.ones(self.decoder.linear.in_features))

    @property
    def num_past(self) -> int:
        """Frames before the present one that are read."""
        return self._num_past

    @property
    def num_window_frames(self) -> int:
        """Frames of the shortest window in which a frame has all it reads."""
        return self.num_past + 1 + self.look_ahead[-1]

    def span(self, num_frames: int) -> range:
        """Frames of a window of ``num_frames`` whose look-ahead lies in it."""
        return frame_span(num_frames, self.num_past, self.look_ahead)

    def _frames(self, state: Tensor) -> Tensor:
        num_frames = state.shape[-2]
        index = frame_index(range(num_frames), num_frames, self.num_past, self.look_ahead, state.device)
        return (state[..., index, :].flatten(-2) - self.offset) / self.scale

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of every frame."""
        return tensordict.set(self.out_key, self.decoder.linear(self._frames(tensordict.get(self.in_key))))

    @torch.no_grad()
    def fit_decoder(self, windows: TensorDictBase, mask: Tensor, *, groups: Tensor | None = None) -> RidgeFit:
        """Fits the regression on the labelled frames that see their whole look-ahead.

        Args:
            windows (TensorDictBase): states ``[N, T, d]`` and actions ``[N, T, act]``.
            mask (Tensor): labelled frames, bool ``[N, T]``.
            groups (Tensor, optional): trajectory of every window, int64 ``[N]``.

        Returns:
            RidgeFit: the ridge chosen and its held-out error.

        Raises:
            ValueError: if no labelled frame sees its whole look-ahead.
        """
        last = mask.shape[-1] - self.look_ahead[-1]
        mask = mask.clone()
        mask[:, : self.num_past], mask[:, last:] = False, False
        self.offset.zero_(), self.scale.fill_(1.0)
        frames = self._frames(windows.get(self.in_key))
        used = frames[mask]
        if len(used):
            spread = used.std(0, correction=0)
            self.offset.copy_(used.mean(0))
            self.scale.copy_(torch.where(spread > 1e-9, spread, torch.ones_like(spread)))
        groups = None if groups is None else groups.unsqueeze(-1).expand_as(mask)
        return self.decoder.fit_ridge(
            self._frames(windows.get(self.in_key)),
            windows.get(self.out_key),
            mask,
            groups=groups,
            input_noise=INPUT_NOISE,
        )
