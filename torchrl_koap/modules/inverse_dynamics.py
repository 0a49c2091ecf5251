# This source code is licensed under the MIT license found in the LICENSE file.
"""What the controllers beside KOAP share: a window of raw states in, raw actions out, and how they look at it."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, LATENT_ACTION, STATE
from torchrl_koap.modules.koopman.latent_action import LatentActionModule
from torchrl_koap.modules.transition_frames import TransitionFrames


class WindowController(TensorDictModuleBase):
    """Base of the controllers: keys, normalisers, and which frames of a window are read.

    Args:
        reader (TransitionFrames or LatentActionModule, optional): gathers what a frame reads. A controller without one
            says itself what it needs (``history``, ``num_window_frames``, ``span``).

    Keyword Args:
        state_normalizer (nn.Module, optional): maps raw states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps predicted actions to raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``, the last out-key. Defaults to ``"action"``.
    """

    def __init__(
        self,
        reader: TransitionFrames | LatentActionModule | None = None,
        *,
        state_normalizer: nn.Module | None = None,
        action_normalizer: nn.Module | None = None,
        in_key: NestedKey = STATE,
        out_key: NestedKey = ACTION,
    ):
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.reader = reader
        self.state_normalizer, self.action_normalizer = state_normalizer, action_normalizer

    def set_keys(self, *, state: NestedKey | None = None, action: NestedKey | None = None) -> None:
        """Renames the entries read and written."""
        if state is not None:
            self.in_keys = [state]
        if action is not None:
            self.out_keys = [*self.out_keys[:-1], action]

    @property
    def history(self) -> int:
        """Frames before the current one that are read."""
        return self.reader.history

    @property
    def num_window_frames(self) -> int:
        """Frames of the shortest window in which a frame has all it reads."""
        return self.reader.num_window_frames

    def span(self, num_frames: int) -> range:
        """Frames of a window of ``num_frames`` that count in the losses: they have all they read inside it."""
        return self.reader.span(num_frames)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Raw states to the networks' units."""
        return state if self.state_normalizer is None else self.state_normalizer(state)

    def normalize_action(self, action: Tensor) -> Tensor:
        """Raw actions to the networks' units."""
        return action if self.action_normalizer is None else self.action_normalizer(action)

    def raw_action(self, action: Tensor) -> Tensor:
        """Inverse of :meth:`normalize_action`."""
        return action if self.action_normalizer is None else self.action_normalizer.inverse(action)

    @torch.no_grad()
    def fit_scales(self, windows: Tensor) -> None:
        """Sets the spread of every step read from windows of raw states ``[*B, T, d]``; no label is read."""
        if self.reader is not None:
            self.reader.fit_scales(self.normalize_state(windows))


class LatentInverseDynamics(WindowController):
    """Base of the controllers with a latent: states to latents to actions.

    A subclass says how a latent is inferred (:meth:`infer`). ``forward`` writes the latent under ``"latent_action"``
    and then the raw action of every frame; offsets beyond the window are clamped to it.

    Args:
        reader (TransitionFrames or LatentActionModule): gathers what a latent is inferred from.
        action_decoder (nn.Module): maps latents to actions in normalised units.

    Keyword Args:
        **kwargs: normalisers and keys, see :class:`WindowController`.
    """

    def __init__(self, reader: TransitionFrames | LatentActionModule, action_decoder: nn.Module, **kwargs):
        super().__init__(reader, **kwargs)
        self.out_keys = [LATENT_ACTION, *self.out_keys]
        self.action_decoder = action_decoder

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Latents ``[*B, T, m]`` of a window of raw states ``[*B, T, d]``, or of some of its ``frames``."""
        raise NotImplementedError

    def decode(self, latent: Tensor) -> Tensor:
        """Actions ``[*B, T, act]`` in normalised units."""
        return self.action_decoder(latent)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes latent and action of every frame."""
        latent = self.infer(tensordict.get(self.in_keys[0]))
        return tensordict.set(self.out_keys[0], latent).set(self.out_keys[1], self.raw_action(self.decode(latent)))
