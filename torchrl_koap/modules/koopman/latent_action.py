# This source code is licensed under the MIT license found in the LICENSE file.
"""Latent actions ("action proxies"), inferred from short state sequences alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import LSTM, MLP

from torchrl_koap.keys import LATENT_ACTION, STATE
from torchrl_koap.modules.time_alignment import FrameGatherer, check_offsets


class LatentActionModule(FrameGatherer, TensorDictModuleBase):
    r"""Base of the latent-action networks: gathers the frames of every step and asks :meth:`infer` for ``u``.

    .. math::
        u_t = f_\theta(x_{t-n}, \dots, x_t, x_{t+k}), \qquad x_{t+1} \text{ is never an input}

    What is gathered is drawn in :class:`~torchrl_koap.modules.time_alignment.FrameGatherer`.

    Args:
        state_dim (int): size ``d`` of a state.
        latent_dim (int): size ``m`` of a latent action.

    Keyword Args:
        num_past (int): number ``n`` of frames before the present one. Defaults to ``1``.
        look_ahead (int or sequence of int): offset ``k >= 2``, or several. Defaults to ``8``.
        relative (bool): read steps at unit scale beside the present frame, instead of frames. Defaults to ``False``.
        clamped (bool): let frames whose look-ahead is cut at the window's end count in the losses.
        in_key (NestedKey): window of states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): latent actions ``[*B, T, m]``. Defaults to ``"latent_action"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules.koopman.latent_action import LatentActionModule
        >>> class Difference(LatentActionModule):  # u_t = x_{t+2} - x_t
        ...     def infer(self, frames):  # [*B, T, F, d]
        ...         return frames[..., -1, :] - frames[..., 0, :]
        >>> network = Difference(1, 1, num_past=0, look_ahead=2)
        >>> network(TensorDict({"state": torch.arange(4.0)[:, None]}))["latent_action"].flatten().tolist()
        [2.0, 2.0, 1.0, 0.0]
    """

    def __init__(
        self,
        state_dim: int,
        latent_dim: int,
        *,
        num_past: int = 1,
        look_ahead: int | Sequence[int] = 8,
        relative: bool = False,
        clamped: bool = False,
        in_key: NestedKey = STATE,
        out_key: NestedKey = LATENT_ACTION,
    ):
        super().__init__(state_dim, num_past=num_past, look_ahead=look_ahead, relative=relative, clamped=clamped)
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.latent_dim = latent_dim

    def infer(self, frames: Tensor) -> Tensor:
        """Latent actions ``[*B, T, m]`` from frames ``[*B, T, F, d]``."""
        raise NotImplementedError

    @property
    def holds_steps(self) -> bool:
        """Whether :meth:`steps` can say where the steps along state columns are."""
        return False

    @property
    def choices(self) -> tuple[str, ...]:
        """Blocks among which the held-out labelled error may choose; none where there is nothing to choose."""
        return ()

    def steps(self, axes: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Where a latent action holds the steps along some state columns, and their size per unit of it.

        Args:
            axes (sequence of int): state columns.

        Returns:
            tuple of Tensor: entries of the latent action, int64 ``[S, len(axes)]``, and factors ``[S, len(axes)]`` that
            turn them into steps in the networks' units; ``S = num_past + len(look_ahead)``.

        Raises:
            ValueError: if it does not hold them.
        """
        raise ValueError(f"{type(self).__name__} does not hold the steps along state columns")

    def fit_unlabelled(self, windows: Tensor) -> None:
        """Fits what is fitted in closed form after the training to windows ``[*B, T, d]``; most have nothing."""

    # reads and writes entries, where a gatherer alone takes states
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:  # type: ignore[override]
        """Writes the latent action of every frame of the window."""
        return tensordict.set(self.out_keys[0], self.infer(self.gather(tensordict.get(self.in_keys[0]))))


class LatentActionLSTM(LatentActionModule):
    """Latent actions by an LSTM over the short sequence ``x_{t-n}, ..., x_t, x_{t+k}`` (the paper's ``f``).

    Args and keys as in :class:`LatentActionModule`.

    Keyword Args:
        hidden_dim (int): width of the LSTM. Defaults to ``128``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LatentActionLSTM
        >>> infer = LatentActionLSTM(2, 8, hidden_dim=16)
        >>> infer(TensorDict({"state": torch.randn(5, 16, 2)}, [5]))["latent_action"].shape
        torch.Size([5, 16, 8])
    """

    def __init__(self, state_dim: int, latent_dim: int, *, hidden_dim: int = 128, **kwargs):
        super().__init__(state_dim, latent_dim, **kwargs)
        self.lstm = LSTM(state_dim, hidden_dim, batch_first=True)
        self.readout = nn.Linear(hidden_dim, latent_dim)

    def infer(self, frames: Tensor) -> Tensor:
        """Runs the LSTM from a zero state and reads its last output."""
        flat = frames.reshape(-1, *frames.shape[-2:])  # [B * T, F, d]
        zeros = flat.new_zeros(1, flat.shape[0], self.lstm.hidden_size)
        out, _ = self.lstm(flat, (zeros, zeros))
        return self.readout(out[:, -1]).reshape(*frames.shape[:-2], self.latent_dim)


class LatentActionMLP(LatentActionModule):
    """Latent actions by a perceptron on the concatenated frames (the released code's ``f``).

    Args and keys as in :class:`LatentActionModule`.

    Keyword Args:
        hidden_dims (sequence of int): widths. Defaults to ``(128, 128)``.
        dropout (float): dropout behind every hidden layer; the released code uses 0.1. Defaults to ``0``.
        linear_skip (bool): add a linear map of the frames, so that an inverse map which is almost linear costs the
            network nothing. Defaults to ``False``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LatentActionMLP
        >>> infer = LatentActionMLP(2, 8, num_past=4, look_ahead=(2, 4, 8), relative=True, linear_skip=True)
        >>> infer(TensorDict({"state": torch.randn(16, 2)}, []))["latent_action"].shape
        torch.Size([16, 8])
    """

    def __init__(
        self,
        state_dim: int,
        latent_dim: int,
        *,
        hidden_dims: Sequence[int] = (128, 128),
        dropout: float = 0.0,
        linear_skip: bool = False,
        **kwargs,
    ):
        super().__init__(state_dim, latent_dim, **kwargs)
        inputs = self.num_frames * state_dim
        self.network = MLP(inputs, latent_dim, num_cells=hidden_dims, activation_class=nn.ReLU, dropout=dropout or None)
        self.skip = nn.Linear(inputs, latent_dim, bias=False) if linear_skip else None

    def infer(self, frames: Tensor) -> Tensor:
        """Applies the perceptron (and the linear map) to the flattened frames."""
        flat = frames.flatten(-2)
        latent = self.network(flat)
        return latent if self.skip is None else latent + self.skip(flat)


class LatentActionFourier(LatentActionModule):
    r"""Latent actions that are themselves observables of the window: a linear and a trainable Fourier part.

    .. math::
        u_t = (v_t / \sqrt{D},\; \sqrt{2 c / p}\, \cos(\Omega [v_t / (\ell_v \sqrt{D}), x_t / \ell_x] + \beta))

    with ``v_t`` the ``D`` entries of the steps between neighbouring frames. A linear decoder under a ridge penalty is
    then Gaussian process regression with a linear plus ``c`` times a squared-exponential kernel (random Fourier
    features): linear where labels are few, curved where they are many. The frequencies and phases are trained by the
    Koopman loss, so the operator needs an input matrix (``KoopmanOperator(input_dim=...)``).

    Args and keys as in :class:`LatentActionModule`, with ``relative`` always on.

    Args:
        state_dim (int): size ``d`` of a state.
        num_features (int): number ``p`` of Fourier features; ``latent_dim`` becomes ``p + D``. With 0 only the linear
            part is left.

    Keyword Args:
        curvature (float): prior variance ``c`` of the curved part against the linear one. Defaults to ``0.1``.
        motion_scale (float): length ``l_v``, in spreads of the steps. Defaults to ``1``.
        position_scale (float): length ``l_x``, in units of the normalised state. Defaults to ``4``.
        place (float): prior standard deviation, against the linear part's, of a further linear part in ``x_t`` itself,
            for actions that say where the robot is to be instead of how it moves; ``latent_dim`` grows by ``d``.
            Defaults to ``0``: none.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LatentActionFourier
        >>> infer = LatentActionFourier(2, 64, num_past=4, look_ahead=(2, 3, 4, 6, 8))
        >>> infer(TensorDict({"state": torch.randn(16, 2)}, []))["latent_action"].shape
        torch.Size([16, 82])
    """

    def __init__(
        self,
        state_dim: int,
        num_features: int,
        *,
        curvature: float = 0.1,
        motion_scale: float = 1.0,
        position_scale: float = 4.0,
        place: float = 0.0,
        **kwargs,
    ):
        num_past, look_ahead = kwargs.get("num_past", 1), kwargs.get("look_ahead", 8)
        motion_dim = (num_past + len(check_offsets(num_past, look_ahead))) * state_dim
        wide = num_features + motion_dim + (state_dim if place else 0)
        super().__init__(state_dim, wide, relative=True, **kwargs)
        self.motion_dim, self.place = motion_dim, place / math.sqrt(state_dim)
        self.amplitude = math.sqrt(2 * curvature / max(num_features, 1))
        self.motion_scale, self.position_scale = motion_scale, position_scale
        self.frequency = nn.Parameter(torch.empty(motion_dim + state_dim, num_features))
        self.phase = nn.Parameter(torch.empty(num_features))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws frequencies and phases of the squared-exponential kernel anew."""
        nn.init.normal_(self.frequency)
        nn.init.uniform_(self.phase, 0.0, 2 * math.pi)

    def infer(self, frames: Tensor) -> Tensor:
        """Evaluates the observables."""
        n = self.num_past
        motion = torch.cat([frames[..., :n, :], frames[..., n + 1 :, :]], -2).flatten(-2) / math.sqrt(self.motion_dim)
        where = torch.cat([motion / self.motion_scale, frames[..., n, :] / self.position_scale], -1)
        curved = self.amplitude * torch.cos(where @ self.frequency + self.phase)
        return torch.cat([motion, curved, *((self.place * frames[..., n, :],) if self.place else ())], -1)

    @property
    def holds_steps(self) -> bool:
        """Its first entries are the steps."""
        return True

    def steps(self, axes: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Where a latent action holds the steps along some state columns (:meth:`LatentActionModule.steps`)."""
        scales = torch.cat([self.scales[: self.num_past], self.scales[self.num_past + 1 :]])[:, list(axes)]
        first = torch.arange(len(scales), device=scales.device)[:, None] * self.state_dim
        return first + torch.tensor(list(axes), device=scales.device), scales * math.sqrt(self.motion_dim)
