# This source code is licensed under the MIT license found in the LICENSE file.
"""Base classes of all controllers: inverse dynamics from a window of raw states to the raw action of every frame."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, LATENT_ACTION, STATE
from torchrl_koap.modules.time_alignment import FrameGatherer


class InverseDynamics(TensorDictModuleBase):
    """Base class of every controller, and all that losses, training and policies ask of one.

    * :attr:`in_key`, :attr:`out_key`, :meth:`set_keys`: the entries read and written;
    * :attr:`num_past`, :attr:`num_window_frames`, :meth:`span`: which frames of a window are read and which count;
    * :meth:`fit_scales`: statistics of its inputs, taken from unlabelled windows (nothing by default);
    * :meth:`normalize_state`, :meth:`normalize_action`, :meth:`raw_action`: units.

    A subclass writes ``forward``. With a ``reader`` all of the above is done; one without says itself what it needs
    (``num_past``, ``num_window_frames``, ``span``).

    Args:
        reader (FrameGatherer, optional): gathers what a frame reads.

    Keyword Args:
        state_normalizer (nn.Module, optional): maps raw states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps predicted actions to raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``, the last out-key; frame ``t`` holds the action from ``x_t``
            to ``x_{t+1}``. Defaults to ``"action"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import InverseDynamics
        >>> from torchrl_koap.modules.time_alignment import FrameGatherer
        >>> class NextStep(InverseDynamics):
        ...     def forward(self, tensordict):
        ...         read = self.reader.gather(tensordict.get(self.in_key))
        ...         return tensordict.set(self.out_key, read[..., -1, :])
        >>> model = NextStep(FrameGatherer(1, num_past=0, look_ahead=1, least=1))
        >>> squares = torch.arange(4.0).square()[:, None]
        >>> model(TensorDict({"state": squares}))["action"].flatten().tolist()  # the last frame has no successor
        [1.0, 3.0, 5.0, 0.0]
        >>> model.num_past, model.num_window_frames, model.span(4)
        (0, 2, range(0, 3))
    """

    reader: FrameGatherer | None
    state_normalizer: nn.Module | None
    action_normalizer: nn.Module | None

    def __init__(
        self,
        reader: FrameGatherer | None = None,
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

    @property
    def in_key(self) -> NestedKey:
        """Entry of the window of raw states."""
        return self.in_keys[0]

    @property
    def out_key(self) -> NestedKey:
        """Entry of the raw actions."""
        return self.out_keys[-1]

    def set_keys(self, *, state: NestedKey | None = None, action: NestedKey | None = None) -> None:
        """Renames the entries read and written.

        Keyword Args:
            state (NestedKey, optional): new :attr:`in_key`.
            action (NestedKey, optional): new :attr:`out_key`.
        """
        if state is not None:
            self.in_keys = [state]
        if action is not None:
            self.out_keys = [*self.out_keys[:-1], action]

    @property
    def num_past(self) -> int:
        """Frames before the present one that are read."""
        return self.reader.num_past

    @property
    def num_window_frames(self) -> int:
        """Frames of the shortest window in which a frame (number ``num_past``) has all it reads and its successor."""
        return self.reader.num_window_frames

    def span(self, num_frames: int) -> range:
        """Frames of a window of ``num_frames`` that count in the losses.

        Raises:
            ValueError: if the window is too short to hold one.
        """
        return self.reader.span(num_frames)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Raw states ``[*B, T, d]`` to the networks' units."""
        return state if self.state_normalizer is None else self.state_normalizer(state)

    def normalize_action(self, action: Tensor) -> Tensor:
        """Raw actions ``[*B, act]`` to the networks' units."""
        return action if self.action_normalizer is None else self.action_normalizer(action)

    def raw_action(self, action: Tensor) -> Tensor:
        """Inverse of :meth:`normalize_action`: actions ``[*B, act]`` in raw units."""
        return action if self.action_normalizer is None else self.action_normalizer.inverse(action)

    @torch.no_grad()
    def fit_scales(self, windows: Tensor) -> None:
        """Sets the spread of every step read from windows of raw states ``[*B, T, d]``; no label is read.

        Does nothing for a controller that has no ``reader``.
        """
        if self.reader is not None:
            self.reader.fit_scales(self.normalize_state(windows))


class LatentInverseDynamics(InverseDynamics):
    """Base of the controllers with a latent: states to latents to actions.

    A subclass says how a latent is inferred (:meth:`infer`). ``forward`` writes the latent under ``"latent_action"``
    and then the raw action of every frame; offsets beyond the window are clamped to it.

    Args:
        reader (FrameGatherer): gathers what a latent is inferred from.
        action_decoder (nn.Module): maps latents to actions in normalised units.

    Keyword Args:
        **kwargs: normalisers and keys, see :class:`InverseDynamics`.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import NonlinearInverseDynamics  # a subclass
        >>> model = NonlinearInverseDynamics(2, 2, latent_dim=8)
        >>> model.out_keys, model.infer(torch.randn(3, 16, 2)).shape
        (['latent_action', 'action'], torch.Size([3, 16, 8]))
    """

    def __init__(self, reader: FrameGatherer, action_decoder: nn.Module, **kwargs):
        super().__init__(reader, **kwargs)
        self.out_keys = [LATENT_ACTION, *self.out_keys]
        self.action_decoder = action_decoder

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Latents of a window of raw states; a subclass says how.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to infer for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), m]``.
        """
        raise NotImplementedError

    def decode(self, latent: Tensor) -> Tensor:
        """Actions ``[*B, T, act]`` in normalised units."""
        return self.action_decoder(latent)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes latent and action of every frame."""
        latent = self.infer(tensordict.get(self.in_key))
        return tensordict.set(self.out_keys[0], latent).set(self.out_key, self.raw_action(self.decode(latent)))
