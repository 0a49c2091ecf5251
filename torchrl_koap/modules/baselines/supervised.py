# This source code is licensed under the MIT license found in the LICENSE file.
"""Inverse dynamics networks that labels alone teach. A window of states in, an action per frame out."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.inverse_dynamics import InverseDynamics
from torchrl_koap.modules.networks import SequenceLSTM
from torchrl_koap.modules.time_alignment import FrameGatherer


class _Supervised(InverseDynamics):
    """States to actions in one step; what is predicted is the subclass's."""

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Normalised actions of a window of raw states.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to predict for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), act]``.
        """
        raise NotImplementedError

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the action of every frame."""
        return tensordict.set(self.out_key, self.raw_action(self.predict(tensordict.get(self.in_key))))


class SupervisedInverseDynamics(_Supervised):
    r"""A perceptron from the frames around a step to its action, trained on labels.

    .. math::
        a_t = f(x_{t-n}, \dots, x_t, x_{t+k_1}, x_{t+k_2}, \dots)

    With ``look_ahead=1`` this is the inverse dynamics of Decision Diffuser, which is told the next state and nothing
    further ahead. KOAP's first public code trains an LSTM instead (:class:`RecurrentInverseDynamics`), whose first
    outputs, those that are executed, are its worst.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        hidden_dims (sequence of int): widths. Defaults to ``(128, 128)``.
        num_past (int): frames ``n`` before the present one. Defaults to ``4``.
        look_ahead (int or sequence of int): offsets ``k >= 1``. Defaults to ``1``.
        **kwargs: normalisers and keys, see :class:`~torchrl_koap.modules.InverseDynamics`.

    Raises:
        ValueError: for a negative ``num_past`` or an offset below 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import SupervisedInverseDynamics
        >>> model = SupervisedInverseDynamics(2, 2, look_ahead=(1, 4))
        >>> model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))["action"].shape
        torch.Size([3, 16, 2])
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        hidden_dims: Sequence[int] = (128, 128),
        num_past: int = 4,
        look_ahead: int | Sequence[int] = 1,
        **kwargs,
    ):
        super().__init__(FrameGatherer(state_dim, num_past=num_past, look_ahead=look_ahead, least=1), **kwargs)
        self.network = MLP(self.reader.num_features, action_dim, num_cells=hidden_dims, activation_class=nn.ReLU)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Normalised actions; frames near the ends read a clamped window.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to predict for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), act]``.
        """
        return self.network(self.reader(self.normalize_state(state), frames))


class RecurrentInverseDynamics(_Supervised):
    """An LSTM that reads ``a_t`` off ``x_0, ..., x_{t+1}``: the supervised controller of KOAP's first public code.

    Outputs at frames ``1 .. T-1`` are the actions of frames ``0 .. T-2``; that of
    the last frame repeats the one before.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        hidden_dim (int): width of the LSTM. Defaults to ``256``.
        num_past (int): frames before the present one that a policy hands over. Defaults to ``1``.
        **kwargs: normalisers and keys, see :class:`~torchrl_koap.modules.InverseDynamics`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import RecurrentInverseDynamics
        >>> model = RecurrentInverseDynamics(2, 2, hidden_dim=16)
        >>> model(TensorDict({"state": torch.randn(3, 16, 2)}, [3]))["action"].shape
        torch.Size([3, 16, 2])
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        hidden_dim: int = 256,
        num_past: int = 1,
        **kwargs,
    ):
        super().__init__(**kwargs)
        self._num_past = num_past
        self.network = SequenceLSTM(state_dim, hidden_dim, action_dim)

    @property
    def num_past(self) -> int:
        """Frames before the present one that a policy hands over."""
        return self._num_past

    @property
    def num_window_frames(self) -> int:
        """Frames of the shortest complete window."""
        return self.num_past + 2

    def span(self, num_frames: int) -> range:
        """Frames of a window that count in the loss: all but the first and the last."""
        return range(1, num_frames - 1)

    def predict(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Normalised actions; the last frame repeats the one before it, for it has no successor.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to predict for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), act]``.
        """
        action = self.network(self.normalize_state(state))[..., 1:, :]
        action = torch.cat([action, action[..., -1:, :]], -2)
        return action if frames is None else action[..., frames.start : frames.stop, :]
