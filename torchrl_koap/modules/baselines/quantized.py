# This source code is licensed under the MIT license found in the LICENSE file.
"""Latent action policies (LAPO) with a quantised latent: what the next state needs beyond the past, as a code."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.modules.windows import WindowReader


class FiniteScalarQuantizer(nn.Module):
    r"""Bounds every entry of a code and rounds it to one of a few levels; gradients pass straight through.

    .. math::
        c_i = \frac{1}{\lfloor L_i / 2 \rfloor}
            \operatorname{round}(\tfrac{L_i - 1}{2} \tanh(z_i + s_i) - o_i),
        \qquad o_i = \tfrac12 [L_i \text{ even}], \quad \tfrac{L_i - 1}{2} \tanh(s_i) = o_i

    after Mentzer et al. 2023 (arXiv 2309.15505). An even number of levels has no middle one: they lie half a level
    lower, and the shift ``s`` keeps 0 at the code 0. There is no codebook to train and no term for it in a loss; a
    codebook is the ``prod(levels)`` codes there are. Several of them stand side by side.

    Args:
        features (int): size ``m`` of what is quantised; a linear map takes it to the entries of the codes, and a second
            one the codes back to ``m``.

    Keyword Args:
        levels (sequence of int): levels of every entry, 3 or more. Defaults to ``(8, 5, 5, 5)``, 1000 codes.
        num_codebooks (int): number ``C`` of codes side by side. Defaults to ``2``.

    Shape:
        ``forward``: ``[*B, m] -> [*B, m]``; codes are ``[*B, C * len(levels)]``.

    Raises:
        ValueError: for fewer than 3 levels or no codebook.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import FiniteScalarQuantizer
        >>> quantizer = FiniteScalarQuantizer(16)
        >>> quantizer(torch.randn(5, 7, 16)).shape
        torch.Size([5, 7, 16])
        >>> quantizer.quantize(torch.tensor([-9.0, -9.0, 0.0, 0.2, 9.0, 9.0, 0.0, 0.4])).tolist()
        [-1.0, -1.0, 0.0, 0.0, 0.75, 1.0, 0.0, 0.5]
    """

    def __init__(self, features: int, *, levels: Sequence[int] = (8, 5, 5, 5), num_codebooks: int = 2):
        super().__init__()
        if not levels or min(levels) < 3:
            raise ValueError(f"every entry of a code needs 3 levels or more, got levels {tuple(levels)}")
        if num_codebooks < 1:
            raise ValueError(f"num_codebooks must be >= 1, got {num_codebooks}")
        self.levels = tuple(levels) * num_codebooks
        self.project_in = nn.Linear(features, len(self.levels))
        self.project_out = nn.Linear(len(self.levels), features)

    def bound(self, values: Tensor) -> Tensor:
        """Squashes values ``[*B, C * len(levels)]`` to the range of the levels, which are the whole numbers in it."""
        levels = torch.tensor(self.levels, dtype=values.dtype, device=values.device)
        half_range, offset = (levels - 1) / 2, (levels % 2 == 0).to(values.dtype) / 2
        return half_range * (values + (offset / half_range).atanh()).tanh() - offset

    def quantize(self, values: Tensor) -> Tensor:
        """Rounds values to codes ``[*B, C * len(levels)]`` in [-1, 1]; the gradient is that of :meth:`bound`."""
        bounded = self.bound(values)
        half = torch.tensor([number // 2 for number in self.levels], device=values.device)
        return (bounded + (bounded.round() - bounded).detach()) / half

    def forward(self, features: Tensor) -> Tensor:
        """Maps features ``[*B, m]`` to ``[*B, m]`` by way of their code."""
        return self.project_out(self.quantize(self.project_in(features)))


class QuantizedInverseDynamics(LatentInverseDynamics):
    r"""Squeezes the steps around a frame into a discrete code, from which a forward model predicts the next state.

    .. math::
        u_t = \mathrm{FSQ}(f_\theta(s_t, x_t)), \qquad
        \hat x_{t+1} - x_t = h_\psi(x_{t-n+1} - x_{t-n}, \dots, x_t - x_{t-1}, x_t, u_t), \qquad a_t = d_\phi(u_t)

    with ``s_t`` the steps between the frames ``x_{t-n}, ..., x_{t+k}`` (:class:`~torchrl_koap.modules.WindowReader`).
    Trained in two stages: :class:`~torchrl_koap.objectives.QuantizedDynamicsLoss` on all windows, then
    :class:`~torchrl_koap.objectives.ActionLoss` with ``freeze_latents`` on the labelled frames. Actions are decoded
    from the code alone. Args as for :class:`~torchrl_koap.modules.InverseDynamics`, and:

    Keyword Args:
        latent_dim (int): size ``m`` of a latent, before the quantisation and after it. Defaults to ``16``.
        hidden_dims (sequence of int): widths of the three networks. Defaults to ``(128, 128)``.
        look_ahead (int or sequence of int): offsets ``k``; 1 must be one of them, the transition that is encoded.

    Raises:
        ValueError: for a look-ahead without 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import QuantizedInverseDynamics
        >>> model = QuantizedInverseDynamics(2, 2)
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
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (1, 2, 3, 4, 5),
        **kwargs,
    ):
        reader = WindowReader(state_dim, num_past=num_past, look_ahead=look_ahead, min_offset=1)
        if reader.look_ahead[0] != 1:
            raise ValueError(f"look_ahead must contain 1, the transition that is encoded, got {reader.look_ahead}")
        layers = {"num_cells": hidden_dims, "activation_class": nn.ReLU}
        super().__init__(reader, MLP(latent_dim, action_dim, **layers), **kwargs)
        self.latent_dim = latent_dim
        self.encoder = MLP(reader.num_features, latent_dim, **layers)
        self.quantizer = FiniteScalarQuantizer(latent_dim)
        self.dynamics = MLP((num_past + 1) * state_dim + latent_dim, state_dim, **layers)

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Infers quantised latents ``[*B, len(frames), m]`` of a window of raw states ``[*B, T, d]``."""
        return self.quantizer(self.encoder(self.reader(self.normalize_state(state), frames)))

    def predict_step(self, state: Tensor, frames: range | None = None) -> tuple[Tensor, Tensor]:
        """Predicts the next step of raw states ``[*B, T, d]`` from the past and the code of the transition.

        Returns:
            tuple of Tensor: the prediction and the step ``x_{t+1} - x_t`` itself, both ``[*B, len(frames), d]`` and
            divided by the step's spread.
        """
        read, size = self.reader(self.normalize_state(state), frames), self.reader.state_dim
        past, step, _ = read.tensor_split(((self.num_past + 1) * size, (self.num_past + 2) * size), -1)
        return self.dynamics(torch.cat([past, self.quantizer(self.encoder(read))], -1)), step
