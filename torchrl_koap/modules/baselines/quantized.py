# This source code is licensed under the MIT license found in the LICENSE file.
"""Latent action policies (LAPO) with a quantised latent: what the next state needs beyond the past, as a code."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.baselines.finite_scalar_quantization import FiniteScalarQuantizer
from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.modules.time_alignment import FrameGatherer


class QuantizedInverseDynamics(LatentInverseDynamics):
    r"""An inverse model squeezes the steps around a frame into a discrete code; a forward model predicts from it.

    .. math::
        u_t = \mathrm{FSQ}(f_\theta(s_t, x_t)), \qquad
        \hat x_{t+1} - x_t = h_\psi(x_{t-n+1} - x_{t-n}, \dots, x_t - x_{t-1}, x_t, u_t), \qquad a_t = d_\phi(u_t)

    with ``s_t`` the steps between the frames ``x_{t-n}, ..., x_{t+k}``
    (:class:`~torchrl_koap.modules.time_alignment.FrameGatherer`) and the quantisation of
    :class:`~torchrl_koap.modules.baselines.finite_scalar_quantization.FiniteScalarQuantizer`. Trained in two stages:
    :class:`~torchrl_koap.objectives.QuantizedDynamicsLoss` on all windows, then
    :class:`~torchrl_koap.objectives.LatentDecoderLoss` on the labelled frames with the inverse model frozen. Actions
    are decoded from the code alone.

    KOAP's first public code differs: it trains both at once, so that the labels
    shape the codes, and its action decoder reads ``x_t`` beside the code.

    Args:
        state_dim (int): size ``d`` of a state.
        action_dim (int): size of an action.

    Keyword Args:
        latent_dim (int): size ``m`` of a latent, before the quantisation and after it. Defaults to ``16``.
        levels (sequence of int): levels of every entry of a code. Defaults to ``(8, 5, 5, 5)``.
        num_codebooks (int): codes side by side. Defaults to ``2``.
        hidden_dims (sequence of int): widths of the three networks. Defaults to ``(128, 128)``.
        num_past (int): number ``n`` of frames before the present one. Defaults to ``4``.
        look_ahead (int or sequence of int): offsets ``k``; 1 must be one of them, the transition that is encoded.
            Defaults to ``(1, 2, 3, 4, 5)``.
        state_normalizer (nn.Module, optional): maps raw states to the networks' units.
        action_normalizer (nn.Module, optional): its ``inverse`` maps decoded actions to raw units.
        in_key (NestedKey): window of raw states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): raw actions ``[*B, T, act]``. Defaults to ``"action"``.

    Raises:
        ValueError: for a negative ``num_past``, a look-ahead without 1, or fewer than 3 levels; at the call for states
            of another size.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import QuantizedInverseDynamics
        >>> model = QuantizedInverseDynamics(2, 2)
        >>> states = torch.randn(3, 16, 2)
        >>> td = model(TensorDict({"state": states}, [3]))
        >>> td["action"].shape, td["latent_action"].shape, model.code_indices(states).shape
        (torch.Size([3, 16, 2]), torch.Size([3, 16, 16]), torch.Size([3, 16, 2]))
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        latent_dim: int = 16,
        levels: Sequence[int] = (8, 5, 5, 5),
        num_codebooks: int = 2,
        hidden_dims: Sequence[int] = (128, 128),
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (1, 2, 3, 4, 5),
        **kwargs,
    ):
        reader = FrameGatherer(state_dim, num_past=num_past, look_ahead=look_ahead, least=1)
        if reader.look_ahead[0] != 1:
            raise ValueError(f"look_ahead must contain 1, the transition that is encoded, got {reader.look_ahead}")
        layers = {"num_cells": hidden_dims, "activation_class": nn.ReLU}
        super().__init__(reader, MLP(latent_dim, action_dim, **layers), **kwargs)
        self.latent_dim = latent_dim
        self.encoder = MLP(reader.num_features, latent_dim, **layers)
        self.quantizer = FiniteScalarQuantizer(latent_dim, levels=levels, num_codebooks=num_codebooks)
        self.dynamics = MLP((num_past + 1) * state_dim + latent_dim, state_dim, **layers)

    def read(self, state: Tensor, frames: range | None = None) -> Tensor:
        """What the inverse model reads.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to read for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), num_features]``, in the networks' units.
        """
        return self.reader(self.normalize_state(state), frames)

    def split(self, read: Tensor) -> tuple[Tensor, Tensor]:
        """What the forward model may read, ``[*B, T, (num_past + 1) * d]``, and the step that it predicts.

        The step ``x_{t+1} - x_t`` is ``[*B, T, d]``, divided by its spread.
        """
        size = self.reader.state_dim
        past, step, _ = read.tensor_split(((self.num_past + 1) * size, (self.num_past + 2) * size), -1)
        return past, step

    def quantized(self, read: Tensor) -> Tensor:
        """Latents ``[*B, T, m]`` by way of their codes."""
        return self.quantizer(self.encoder(read))

    def predict_step(self, past: Tensor, latent: Tensor) -> Tensor:
        """The next step, at unit scale.

        Args:
            past (Tensor): what the forward model may read (:meth:`split`), ``[*B, T, (num_past + 1) * d]``.
            latent (Tensor): quantised latents ``[*B, T, m]``.

        Returns:
            Tensor: ``[*B, T, d]``.
        """
        return self.dynamics(torch.cat([past, latent], -1))

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Quantised latents of a window of raw states.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to infer for. Default: all ``T`` of the window.

        Returns:
            Tensor: ``[*B, len(frames), m]``.
        """
        return self.quantized(self.read(state, frames))

    def code_indices(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Numbers of the codes: how many are in use tells how rich the latent is.

        Args:
            state (Tensor): window of raw states ``[*B, T, d]``.
            frames (range, optional): frames to infer for. Default: all ``T`` of the window.

        Returns:
            Tensor: int64 ``[*B, len(frames), num_codebooks]``.
        """
        return self.quantizer.codes_to_indices(self.quantizer.encode(self.encoder(self.read(state, frames))))
