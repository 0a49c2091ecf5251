# This source code is licensed under the MIT license found in the LICENSE file.
"""Controllers with latents trained on unlabelled windows: discrete codes (LAPO), and a variational auto-encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.modules.baselines.networks import LAYERS
from torchrl_koap.modules.inverse_dynamics import LatentInverseDynamics
from torchrl_koap.modules.windows import WindowReader

LATENT_DIM = 16
LEVELS = (8, 5, 5, 5) * 2  # two codebooks of 1000 codes side by side
WINDOW = 16  # frames of the windows that the auto-encoder reads


class FiniteScalarQuantizer(nn.Module):
    r"""Bounds every entry of a code and rounds it to one of a few levels; gradients pass straight through.

    .. math::
        c_i = \frac{1}{\lfloor L_i / 2 \rfloor}
            \operatorname{round}(\tfrac{L_i - 1}{2} \tanh(z_i + s_i) - o_i),
        \qquad o_i = \tfrac12 [L_i \text{ even}], \quad \tfrac{L_i - 1}{2} \tanh(s_i) = o_i

    after Mentzer et al. 2023 (arXiv 2309.15505). An even number of levels has no middle level: they lie half a level
    lower, and the shift ``s`` maps 0 to the code 0. One linear map converts ``features`` ``[*B, m]`` to the entries of
    a code; a second one converts codes back.
    """

    def __init__(self, features: int):
        super().__init__()
        self.project_in = nn.Linear(features, len(LEVELS))
        self.project_out = nn.Linear(len(LEVELS), features)

    def bound(self, values: Tensor) -> Tensor:
        """Squashes values ``[*B, 8]`` to the range of the levels; the integers in it are the levels."""
        levels = torch.tensor(LEVELS, dtype=values.dtype, device=values.device)
        half_range, offset = (levels - 1) / 2, (levels % 2 == 0).to(values.dtype) / 2
        return half_range * (values + (offset / half_range).atanh()).tanh() - offset

    def quantize(self, values: Tensor) -> Tensor:
        """Rounds values to codes ``[*B, 8]`` in [-1, 1]; the gradient is that of :meth:`bound`."""
        bounded = self.bound(values)
        half = torch.tensor([number // 2 for number in LEVELS], device=values.device)
        return (bounded + (bounded.round() - bounded).detach()) / half

    def forward(self, features: Tensor) -> Tensor:
        """Quantises features ``[*B, m]`` to codes and maps these back to ``[*B, m]``."""
        return self.project_out(self.quantize(self.project_in(features)))


class QuantizedInverseDynamics(LatentInverseDynamics):
    r"""Encodes the steps around a frame as a discrete code; a forward model predicts the next state from it.

    .. math::
        u_t = \mathrm{FSQ}(f_\theta(s_t, x_t)), \qquad
        \hat x_{t+1} - x_t = h_\psi(x_{t-n+1} - x_{t-n}, \dots, x_t - x_{t-1}, x_t, u_t), \qquad a_t = d_\phi(u_t)

    with ``s_t`` the steps between the frames ``x_{t-n}, ..., x_{t+k}`` (:class:`~torchrl_koap.modules.WindowReader`).
    Trained in two stages: :class:`~torchrl_koap.objectives.QuantizedDynamicsLoss` on all windows, then
    :class:`~torchrl_koap.objectives.ActionLoss` with ``freeze_latents`` on the labelled frames. Actions are decoded
    only from the code. Args as for :class:`~torchrl_koap.modules.InverseDynamics`, and:

    Keyword Args:
        look_ahead (int or sequence of int): offsets ``k``; they must contain 1, the transition that is encoded.

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
        num_past: int = 4,
        look_ahead: int | Sequence[int] = (1, 2, 3, 4, 5),
        **kwargs,
    ):
        reader = WindowReader(state_dim, num_past=num_past, look_ahead=look_ahead, min_offset=1)
        if reader.look_ahead[0] != 1:
            raise ValueError(f"look_ahead must contain 1, the transition that is encoded, got {reader.look_ahead}")
        super().__init__(reader, MLP(LATENT_DIM, action_dim, **LAYERS), **kwargs)
        self.encoder = MLP(reader.num_features, LATENT_DIM, **LAYERS)
        self.quantizer = FiniteScalarQuantizer(LATENT_DIM)
        self.dynamics = MLP((num_past + 1) * state_dim + LATENT_DIM, state_dim, **LAYERS)

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Infers quantised latents ``[*B, len(frames), m]`` of a window of raw states ``[*B, T, d]``."""
        return self.quantizer(self.encoder(self.reader(self.normalize_state(state), frames)))

    def predict_step(self, state: Tensor, frames: range | None = None) -> tuple[Tensor, Tensor]:
        """Predicts the next step of raw states ``[*B, T, d]`` from the past and the code of the transition.

        Returns the prediction and the true step ``x_{t+1} - x_t``, ``[*B, len(frames), d]``, divided by its spread.
        """
        read, size = self.reader(self.normalize_state(state), frames), self.reader.state_dim
        past, step, _ = read.tensor_split(((self.num_past + 1) * size, (self.num_past + 2) * size), -1)
        return self.dynamics(torch.cat([past, self.quantizer(self.encoder(read))], -1)), step


class VariationalInverseDynamics(LatentInverseDynamics):
    r"""Encodes a window into one Gaussian latent per frame; a decoder reconstructs the frame's input from samples.

    .. math::
        q(u_t \mid x_{0:T}) = N(\mu_\theta(h_t), \sigma^2_\theta(h_t)), \quad h = \mathrm{LSTM}_\theta(s_{0:T}), \qquad
        \hat s_t = g_\psi(u_t), \qquad a_t = d_\phi(u_t), \quad u_t \sim q

    with ``s_t`` the present state and the steps to and from it (:class:`~torchrl_koap.modules.WindowReader`), and an
    LSTM that runs over the window in both directions. Trained in two stages, as in the paper:
    :class:`~torchrl_koap.objectives.VariationalLoss` on all windows, then :class:`~torchrl_koap.objectives.ActionLoss`
    with ``freeze_latents``, on samples, on the labelled frames. In a policy it decodes the mean. Args as for
    :class:`~torchrl_koap.modules.InverseDynamics`, without ``num_past`` and ``look_ahead``.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import VariationalInverseDynamics
        >>> model = VariationalInverseDynamics(2, 2)
        >>> model.sample(torch.randn(1, 16, 2)).shape
        torch.Size([1, 16, 16])
    """

    num_window_frames = WINDOW

    def __init__(self, state_dim: int, action_dim: int, **kwargs):
        reader = WindowReader(state_dim, num_past=1, look_ahead=1, min_offset=1)
        super().__init__(reader, MLP(LATENT_DIM, action_dim, **LAYERS), **kwargs)
        self.context = nn.LSTM(reader.num_features, 128, batch_first=True, bidirectional=True)
        self.encoder = nn.Linear(2 * 128, 2 * LATENT_DIM)
        self.decoder = MLP(LATENT_DIM, reader.num_features, num_cells=(128,), activation_class=nn.ReLU)

    def posterior(self, state: Tensor, frames: range | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Infers the distribution of the latents of a window of raw states ``[*B, T, d]``.

        Returns the input of every frame ``[*B, len(frames), 3 d]``, at unit scale, and mean and log-variance of the
        latents ``[*B, len(frames), m]``.
        """
        read = self.reader(self.normalize_state(state))  # [*B, T, F]
        context, _ = self.context(read.reshape(-1, *read.shape[-2:]))
        context = context.reshape(*read.shape[:-1], 2 * self.context.hidden_size)
        if frames is not None:
            read, context = (part[..., frames.start : frames.stop, :] for part in (read, context))
        mean, log_variance = self.encoder(context).chunk(2, -1)
        return read, mean, log_variance.clamp(-10.0, 10.0)  # outliers must not overflow the exponential

    def infer(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Infers the means ``[*B, len(frames), m]`` of the latents of a window of raw states ``[*B, T, d]``."""
        return self.posterior(state, frames)[1]

    def sample(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Samples latents ``[*B, len(frames), m]`` of a window of raw states ``[*B, T, d]``."""
        _, mean, log_variance = self.posterior(state, frames)
        return mean + (0.5 * log_variance).exp() * torch.randn_like(mean)
