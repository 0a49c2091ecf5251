# This source code is licensed under the MIT license found in the LICENSE file.
"""Base classes of all controllers, which map a window of raw states to the raw action of every frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, EPISODE, LATENT_ACTION, STATE, check_actions, check_window, frame_mask, read_entry
from torchrl_koap.modules.windows import WindowReader

BATCH = 4096  # windows that are processed at once


class InverseDynamics(TensorDictModuleBase):
    """Maps windows of raw states to the raw action of every frame: the interface to losses, training and policies.

    A subclass defines :meth:`predict`, and overrides other methods as needed. Training calls, in this order,
    :meth:`prepare`, the losses, :meth:`finish`, and :meth:`fit_labels` if the method has a decoder in closed form.

    Subclasses take the sizes ``state_dim`` of a state (as it is read) and ``action_dim`` of an action, and the keywords
    below. Those that read steps also take ``num_past``, the number of frames before the present one, and
    ``look_ahead``, one offset or several.

    Args:
        reader (WindowReader, optional): reads the input of every frame. A subclass without one defines ``num_past``,
            ``num_window_frames`` and :meth:`valid_frames` itself.

    Keyword Args:
        state_normalizer (nn.Module, optional): maps states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps predicted actions to raw units.

    It reads the window of raw states ``[*B, T, d]`` from ``"state"`` and writes raw actions ``[*B, T, act]`` to
    ``"action"``, its last out-key; :meth:`set_keys` renames both. Frame ``t`` holds the action from ``x_t`` to
    ``x_{t+1}``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import InverseDynamics, WindowReader
        >>> class NextStep(InverseDynamics):
        ...     def predict(self, state, frames=None):
        ...         return self.reader.gather(self.normalize_state(state), frames)[..., -1, :]
        >>> model = NextStep(WindowReader(1, num_past=0, look_ahead=1, min_offset=1))
        >>> squares = torch.arange(4.0).square()[:, None]
        >>> model(TensorDict({"state": squares}))["action"].flatten().tolist()  # the last frame has no successor
        [1.0, 3.0, 5.0, 0.0]
        >>> model.num_past, model.num_window_frames, model.valid_frames(4)
        (0, 2, range(0, 3))
    """

    reader: WindowReader | None

    def __init__(
        self,
        reader: WindowReader | None = None,
        *,
        state_normalizer: nn.Module | None = None,
        action_normalizer: nn.Module | None = None,
    ):
        super().__init__()
        self.in_keys, self.out_keys = [STATE], [ACTION]
        self._out_key: NestedKey = ACTION  # select_out_keys() may remove it from out_keys
        self.register_module("reader", reader)  # a subclass whose part holds the reader overrides this by a property
        self.state_normalizer, self.action_normalizer = state_normalizer, action_normalizer

    @property
    def in_key(self) -> NestedKey:
        """Entry of the window of raw states."""
        return self.in_keys[0]

    @property
    def out_key(self) -> NestedKey:
        """Entry of the raw actions."""
        return self._out_key

    def set_keys(self, *, state: NestedKey | None = None, action: NestedKey | None = None) -> None:
        """Renames :attr:`in_key`, :attr:`out_key` or both."""
        if state is not None:
            self.in_keys = [state]
        if action is not None:
            self.out_keys = [action if key == self._out_key else key for key in self.out_keys]
            self._out_key = action

    @property
    def num_past(self) -> int:
        """Frames before the present one that are read."""
        return self.reader.num_past

    @property
    def num_window_frames(self) -> int:
        """Length of the shortest window that holds a frame, its successor and all frames read for it."""
        return self.reader.num_window_frames

    def valid_frames(self, num_frames: int) -> range:
        """Returns the frames of a window of ``num_frames`` that count in the losses (:class:`WindowReader`)."""
        return self.reader.valid_frames(num_frames)

    def normalize_state(self, state: Tensor) -> Tensor:
        """Maps raw states ``[*B, T, d]`` to the networks' units."""
        return state if self.state_normalizer is None else self.state_normalizer(state)

    def normalize_action(self, action: Tensor) -> Tensor:
        """Maps raw actions ``[*B, act]`` to the networks' units."""
        return action if self.action_normalizer is None else self.action_normalizer(action)

    def raw_action(self, action: Tensor) -> Tensor:
        """Inverts :meth:`normalize_action`."""
        return action if self.action_normalizer is None else self.action_normalizer.inverse(action)

    def prepare(self, windows: Tensor, *, updates: int = 0, progress: Callable[[int, int], None] | None = None) -> None:
        """Fits, before training, what raw states ``[*B, T, d]`` determine without labels: the spread of every step.

        A subclass may train a network for ``updates`` steps; it calls ``progress(updates done, all updates)``.
        """
        if self.reader is not None:
            self.reader.fit(self.normalize_state(windows))

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Predicts actions ``[*B, len(frames), act]`` in normalised units; subclasses define it.

        The window of raw states is ``[*B, T, d]``; ``frames`` defaults to all ``T``. Offsets are clamped to the window.
        """
        raise NotImplementedError

    def finish(self, windows: Tensor) -> None:
        """Fits parts after training, to raw states ``[*B, T, d]`` without labels. The base class has none."""

    def fit_labels(
        self,
        windows: TensorDictBase,
        mask: Tensor,
        *,
        axes: Sequence[int] = (),
        guessed: bool = False,
        alike: bool = True,
    ) -> dict[str, Any]:
        """Fits a decoder in closed form on the labelled frames of windows; subclasses with such a decoder define it.

        Args:
            windows (TensorDictBase): raw states ``[*B, T, d]`` and actions ``[*B, T, act]``. For held-out errors, all
                frames of a trajectory (``episode``, int64 ``[*B]`` or ``[*B, T]``) are left out together. Without this
                entry frames are left out one by one, and overlapping windows then hide overfitting.
            mask (Tensor): labelled frames to use, bool ``[*B, T]`` or ``[*B, T, 1]``; no other action is read. Frames
                that do not count in the losses (:meth:`valid_frames`) are ignored.

        Keyword Args:
            axes (sequence of int): for each action entry, the state column (of those read) that it moves.
            guessed (bool): the axes are likely, but not certain.
            alike (bool): the action entries are of one kind and share one penalty.

        Returns:
            dict: numbers for the summary (:meth:`~torchrl_koap.modules.ridge.RidgeFit.summary`).

        Raises:
            ValueError: if no labelled frame counts, or shapes disagree.
        """
        raise NotImplementedError(f"{type(self).__name__} has no decoder in closed form")

    def labelled_frames(
        self, read: Callable[[Tensor, range], Tensor], windows: TensorDictBase, mask: Tensor
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """Selects the data that :meth:`fit_labels` fits a decoder to; ``windows`` and ``mask`` are its arguments.

        ``read`` maps raw states ``[N, T, d]`` and a range of frames to the decoder's input ``[N, frames, m]``. Returns
        inputs ``[n, m]``, normalised actions ``[n, act]``, and trajectory numbers ``[n]``, None if unknown.
        """
        states = self._read_window(windows)
        action = check_actions(read_entry(self, windows, self.out_key, "set_keys(action=...)"), self.out_key, states)
        mask, groups = frame_mask(mask, "mask", states), windows.get(EPISODE, None)
        if groups is not None:
            groups = groups.reshape(*states.shape[:-2], -1)[..., -1]
        frames = self.valid_frames(mask.shape[-1])
        part = slice(frames.start, frames.stop)
        mask = mask[..., part]
        rows = mask.any(-1)
        if not rows.any():
            raise ValueError(f"no labelled frame lies in frames {frames.start}..{frames.stop - 1} of any window")
        states, action, mask = states[rows], action[rows], mask[rows]
        parts = zip(states.split(BATCH), mask.split(BATCH), strict=True)
        inputs = torch.cat([read(some, frames)[counts] for some, counts in parts])
        action = self.normalize_action(action[:, part][mask])
        return inputs, action, None if groups is None else groups[rows].unsqueeze(-1).expand_as(mask)[mask]

    def _read_window(self, tensordict: TensorDictBase) -> Tensor:
        state = read_entry(self, tensordict, self.in_key, "set_keys(state=...)")
        return check_window(tensordict, self.in_key, state)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of every frame. Raises a ValueError for a flat batch of several trajectories."""
        state = self._read_window(tensordict)
        return tensordict.set(self.out_key, self.raw_action(self.predict(state)))


class LatentInverseDynamics(InverseDynamics):
    """Base class of controllers that map states to latents, and latents to actions.

    A subclass defines how latents are inferred (:meth:`infer`). ``forward`` writes the latent under ``"latent_action"``
    and then the raw action of every frame. The decoder maps latents to actions in normalised units; the other arguments
    are those of :class:`InverseDynamics`.
    """

    def __init__(self, reader: WindowReader | None, action_decoder: nn.Module, **kwargs):
        super().__init__(reader, **kwargs)
        self.out_keys = [LATENT_ACTION, *self.out_keys]
        self.latent_key: NestedKey = LATENT_ACTION
        self.action_decoder = action_decoder

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Infers the latents ``[*B, len(frames), m]`` of raw states ``[*B, T, d]``; subclasses define it."""
        raise NotImplementedError

    def sample(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Samples the latents; without a distribution, these are the inferred ones."""
        return self.infer(state, frames)

    def decode(self, latent: Tensor) -> Tensor:
        """Decodes latents ``[*B, T, m]`` to actions ``[*B, T, act]`` in normalised units."""
        return self.action_decoder(latent)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Predicts actions ``[*B, len(frames), act]`` in normalised units."""
        return self.decode(self.infer(state, frames))

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes latent and action of every frame."""
        state = self._read_window(tensordict)
        latent = self.infer(state)
        tensordict.set(self.latent_key, latent)
        return tensordict.set(self.out_key, self.raw_action(self.decode(latent)))
