# This source code is licensed under the MIT license found in the LICENSE file.
"""A variational auto-encoder of short trajectories as controller, and what all controllers with a latent share."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.keys import ACTION, LATENT_ACTION, STATE
from torchrl_koap.modules.latent_action import LatentActionModule
from torchrl_koap.modules.recurrent import mlp
from torchrl_koap.modules.transition_frames import TransitionFrames


class LatentInverseDynamics(TensorDictModuleBase):
    """Base of the controllers with a latent that KOAP is measured against: states to latents to actions.

    A subclass says how a latent is inferred (:meth:`infer`). ``forward`` writes the latent under ``"latent_action"``
    and then the raw action of every frame; offsets beyond the window are clamped to it.

    Args:
        reader (TransitionFrames or LatentActionModule): gathers what a latent is inferred from.
        action_decoder (nn.Module): maps latents to actions in normalised units.

    Keyword Args:
        state_normalizer (nn.Module, optional): maps raw states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps decoded actions to raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``. Defaults to ``"action"``.
    """

    def __init__(
        self,
        reader: TransitionFrames | LatentActionModule,
        action_decoder: nn.Module,
        *,
        state_normalizer: nn.Module | None = None,
        action_normalizer: nn.Module | None = None,
        in_key: NestedKey = STATE,
        out_key: NestedKey = ACTION,
    ):
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [LATENT_ACTION, out_key]
        self.reader, self.action_decoder = reader, action_decoder
        self.state_normalizer, self.action_normalizer = state_normalizer, action_normalizer

    def set_keys(self, *, state: NestedKey | None = None, action: NestedKey | None = None) -> None:
        """Renames the entries read and written."""
        if state is not None:
            self.in_keys = [state]
        if action is not None:
            self.out_keys = [LATENT_ACTION, action]

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
        """Raw actions to the decoder's units."""
        return action if self.action_normalizer is None else self.action_normalizer(action)

    @torch.no_grad()
    def fit_scales(self, windows: Tensor) -> None:
        """Sets the spread of every step read from windows of raw states ``[*B, T, d]``; no label is read."""
        self.reader.fit_scales(self.normalize_state(windows))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Latents ``[*B, T, m]`` of a window of raw states ``[*B, T, d]``, or of some of its ``frames``."""
        raise NotImplementedError

    def decode(self, latent: Tensor) -> Tensor:
        """Actions ``[*B, T, act]`` in normalised units."""
        return self.action_decoder(latent)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes latent and action of every frame."""
        latent = self.infer(tensordict.get(self.in_keys[0]))
        action = self.decode(latent)
        action = action if self.action_normalizer is None else self.action_normalizer.inverse(action)
        return tensordict.set(self.out_keys[0], latent).set(self.out_keys[1], action)


class VariationalInverseDynamics(LatentInverseDynamics):
    r"""Encodes the steps around a frame in a Gaussian latent; an action decoder reads its mean.

    .. math::
        q(u_t \mid s_t) = N(\mu_\theta(s_t, x_t), \sigma^2_\theta(s_t, x_t)), \qquad
        \hat s_t = g_\psi(u_t, x_t), \quad u_t \sim q, \qquad a_t = d_\phi(\mu_\theta(s_t, x_t))

    with ``s_t`` the steps between the frames ``x_{t-n}, ..., x_{t+k}``
    (:class:`~torchrl_koap.modules.transition_frames.TransitionFrames`). Trained in two stages, as the paper says:
    :class:`~torchrl_koap.objectives.VariationalLoss` on all windows, then
    :class:`~torchrl_koap.objectives.LatentDecoderLoss` on the labelled frames with the encoder frozen.

    The first public code (``koap_release_notes`` 3.5 and 7.10) differs: it reconstructs from a deterministic code
    beside the latent, so that the latent need not hold anything; it feeds a sample to the action decoder, also at
    inference; and it trains all parts at once.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        latent_dim (int): size ``m`` of a latent. Defaults to ``16``.
        hidden_dims (sequence of int): widths of the three networks. Defaults to ``(128, 128)``.
        history (int): number ``n`` of frames before the current one. Defaults to ``4``.
        look_ahead (int or sequence of int): offsets ``k``. Defaults to ``(1, 2, 3, 4, 5)``.
        state_normalizer (nn.Module, optional): maps raw states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps decoded actions to raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``. Defaults to ``"action"``.

    Raises:
        ValueError: for a negative history or an offset below 1; at the call for states of another size.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> model = VariationalInverseDynamics(2, 2)
        >>> td = model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))
        >>> td["action"].shape, td["latent_action"].shape
        (torch.Size([3, 16, 2]), torch.Size([3, 16, 16]))
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        latent_dim: int = 16,
        hidden_dims: Sequence[int] = (128, 128),
        history: int = 4,
        look_ahead: int | Sequence[int] = (1, 2, 3, 4, 5),
        **kwargs,
    ):
        reader = TransitionFrames(state_dim, history=history, look_ahead=look_ahead)
        super().__init__(reader, mlp(latent_dim, hidden_dims, action_dim), **kwargs)
        self.latent_dim = latent_dim
        self.encoder = mlp(reader.num_features, hidden_dims, 2 * latent_dim)
        self.decoder = mlp(latent_dim + state_dim, hidden_dims, reader.num_features - state_dim)

    def read(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What the encoder reads, ``[*B, T, num_features]``, of raw states ``[*B, T, d]``."""
        return self.reader(self.normalize_state(state), frames)

    def split(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """The present state ``[*B, T, d]`` and the steps around it ``[*B, T, num_features - d]``."""
        size = self.reader.state_dim
        before, present, after = read.tensor_split((self.history * size, (self.history + 1) * size), -1)
        return present, torch.cat([before, after], -1)

    def posterior(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance ``[*B, T, m]`` of the latent."""
        mean, log_variance = self.encoder(read).chunk(2, -1)
        return mean, log_variance.clamp(-10.0, 10.0)  # one odd window must not overflow the exponential

    def reconstruct(self, latent: Tensor, present: Tensor) -> Tensor:
        """Steps ``[*B, T, num_features - d]`` from latents and the present state alone."""
        return self.decoder(torch.cat([latent, present], -1))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Means ``[*B, T, m]`` of the latents of a window of raw states ``[*B, T, d]``, or of some ``frames`` of it."""
        return self.posterior(self.read(state, frames))[0]
