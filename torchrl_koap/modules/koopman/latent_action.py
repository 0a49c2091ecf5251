# This source code is licensed under the MIT license found in the LICENSE file.
"""Networks that infer latent actions ("action proxies") from short sequences of states, and their linear decoder."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torchrl.modules import LSTM, MLP

from torchrl_koap.keys import ACTION, LATENT_ACTION, STATE, check_window, read_entry
from torchrl_koap.modules.ridge import RidgeFit
from torchrl_koap.modules.windows import WindowReader


class LatentActionModule(TensorDictModuleBase):
    r"""Base class of the latent-action networks, which read the frames around every step and infer ``u`` from them.

    .. math::
        u_t = f_\theta(x_{t-n}, \dots, x_t, x_{t+k}), \qquad x_{t+1} \text{ is never an input}

    A subclass defines :meth:`infer`; :class:`~torchrl_koap.modules.WindowReader` shows its input.

    Args:
        state_dim (int): size ``d`` of a state.
        latent_dim (int): size ``m`` of a latent action.

    Keyword Args:
        num_past, look_ahead, relative, clamped: options of the :class:`~torchrl_koap.modules.WindowReader`. Defaults
            are the paper's: one past frame, one frame 8 steps ahead, frames instead of steps.
        in_key, out_key (NestedKey): window of states ``[*B, T, d]`` in the network's units, and latent actions
            ``[*B, T, m]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LatentActionModule
        >>> class Difference(LatentActionModule):  # u_t = x_{t+2} - x_t
        ...     def infer(self, read):  # [*B, T, F, d]
        ...         return read[..., -1, :] - read[..., 0, :]
        >>> network = Difference(1, 1, num_past=0, look_ahead=2)
        >>> network(TensorDict({"state": torch.arange(4.0)[:, None]}))["latent_action"].flatten().tolist()
        [2.0, 2.0, 1.0, 0.0]
    """

    blocks: tuple[str, ...] = ("",)  # alternative parts of a latent action, of which labels choose one
    min_trajectories = 3  # labelled ones needed to choose; with fewer, the first block is kept

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
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.state_dim, self.latent_dim = state_dim, latent_dim
        self.reader = WindowReader(
            state_dim, num_past=num_past, look_ahead=look_ahead, relative=relative, clamped=clamped
        )

    def infer(self, read: Tensor) -> Tensor:
        """Infers latent actions ``[*B, T, m]`` from the output ``[*B, T, F, d]`` of :meth:`gather`."""
        raise NotImplementedError

    def gather(self, state: Tensor, frames: range | None = None) -> Tensor:
        """Reads a window of states ``[*B, T, d]`` (:meth:`WindowReader.gather`): ``[*B, len(frames), F, d]``."""
        return self.reader.gather(state, frames)

    def axis_features(self, axes: Sequence[int]) -> tuple[Tensor, Tensor] | None:
        """Returns which entries of a latent action hold the steps along some state columns; None if none do.

        The entries are int64 ``[S, len(axes)]`` with ``S = num_past + len(look_ahead)``. Factors of the same shape
        convert them to steps in the networks' units.
        """
        return None

    def best_block(self, errors: Mapping[str, float]) -> str:
        """Returns the block that labels choose: the one with the least of the held-out ``errors``, by block."""
        return min(errors, key=lambda block: errors[block])

    def choose(self, block: str) -> None:
        """Selects one of :attr:`blocks`."""

    def prepare(self, windows: Tensor) -> None:
        """Computes, before training, the spread of the steps from windows ``[*B, T, d]`` without labels."""
        self.reader.fit(windows)

    def finish(self, windows: Tensor) -> None:
        """Fits parts after training, to windows ``[*B, T, d]`` without labels. The base class has none."""

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the latent action of every frame. Raises a ValueError for a flat batch of several trajectories."""
        state = check_window(tensordict, self.in_keys[0], read_entry(self, tensordict, self.in_keys[0]))
        return tensordict.set(self.out_keys[0], self.infer(self.gather(state)))


class LatentActionLSTM(LatentActionModule):
    """Infers latent actions by an LSTM over ``x_{t-n}, ..., x_t, x_{t+k}`` (the paper's ``f``).

    Args as for :class:`LatentActionModule`, and:

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
        self.lstm = LSTM(state_dim, hidden_dim, batch_first=True)  # unlike torch's, it can be traced by torch.compile
        self.readout = nn.Linear(hidden_dim, latent_dim)

    def infer(self, read: Tensor) -> Tensor:
        """Runs the LSTM from a zero state and maps its last output to ``[*B, T, m]``."""
        flat = read.reshape(-1, *read.shape[-2:])  # [B * T, F, d]
        zeros = flat.new_zeros(1, flat.shape[0], self.lstm.hidden_size)
        out, _ = self.lstm(flat, (zeros, zeros))
        return self.readout(out[:, -1]).reshape(*read.shape[:-2], self.latent_dim)


class LatentActionMLP(LatentActionModule):
    """Infers latent actions by a perceptron on the concatenated frames, of widths ``hidden_dims``.

    Args as for :class:`LatentActionModule`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LatentActionMLP
        >>> infer = LatentActionMLP(2, 8, num_past=4, look_ahead=(2, 4, 8), relative=True)
        >>> infer(TensorDict({"state": torch.randn(5, 16, 2)}, [5]))["latent_action"].shape
        torch.Size([5, 16, 8])
    """

    def __init__(self, state_dim: int, latent_dim: int, *, hidden_dims: Sequence[int] = (128, 128), **kwargs):
        super().__init__(state_dim, latent_dim, **kwargs)
        self.network = MLP(self.reader.num_features, latent_dim, num_cells=hidden_dims, activation_class=nn.ReLU)

    def infer(self, read: Tensor) -> Tensor:
        """Applies the perceptron to the flattened frames: ``[*B, T, m]``."""
        return self.network(read.flatten(-2))


class FourierKernel(NamedTuple):
    """The covariance of a function that is linear in the features of :class:`LatentActionFourier`.

    Args:
        curvature (float): prior variance ``c`` of the Fourier part, relative to the linear one.
        motion_scale (float): length scale ``l_v``, in spreads of the steps.
        position_scale (float): length scale ``l_x``, in units of the normalised state.
    """

    curvature: float = 0.1
    motion_scale: float = 1.0
    position_scale: float = 4.0


class LatentActionFourier(LatentActionModule):
    r"""Computes latent actions as observables of the window, with a linear and a trainable Fourier part.

    .. math::
        u_t = (v_t / \sqrt{D},\; \sqrt{2 c / p}\, \cos(\Omega [v_t / (\ell_v \sqrt{D}), x_t / \ell_x] + \beta))

    with ``v_t`` the ``D`` entries of the steps between neighbouring frames. A linear decoder under a ridge penalty is
    then Gaussian process regression with a linear plus ``c`` times a squared-exponential kernel (random Fourier
    features). The Koopman loss trains frequencies and phases, so the operator needs an input matrix
    (``KoopmanOperator(input_dim=...)``). Of several kernels, it trains with the first; then the labels of three
    or more trajectories choose one (:meth:`best_block`).

    Keywords as for :class:`LatentActionModule`, ``relative`` always on, and those below.

    Args:
        state_dim (int): size ``d`` of a state.
        num_features (int): number ``p`` of Fourier features; ``latent_dim`` becomes ``p + D``. With 0 only the linear
            part is left.

    Keyword Args:
        kernels (dict): a :class:`FourierKernel` for each name, the name of its block. Defaults to one.
        position_weight (float): prior standard deviation, relative to the linear part's, of a second linear part in
            ``x_t`` itself, for absolute actions; ``latent_dim`` grows by ``d``. Defaults to ``0``: none.
        trainable (bool): train frequencies and phases; otherwise they stay as drawn. Defaults to ``True``.

    Raises:
        ValueError: without a kernel, and as the :class:`~torchrl_koap.modules.WindowReader`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LatentActionFourier
        >>> infer = LatentActionFourier(2, 64, num_past=4, look_ahead=(2, 3, 4, 6, 8))
        >>> infer(TensorDict({"state": torch.randn(16, 2)}, []))["latent_action"].shape
        torch.Size([16, 82])
    """

    frequency: Tensor
    phase: Tensor
    kernel: Tensor | tuple[float, float, float]

    def __init__(
        self,
        state_dim: int,
        num_features: int,
        *,
        kernels: Mapping[str, FourierKernel] = MappingProxyType({"": FourierKernel()}),
        position_weight: float = 0.0,
        trainable: bool = True,
        **kwargs,
    ):
        if not kernels:
            raise ValueError("kernels: at least one FourierKernel is needed, there is none")
        super().__init__(state_dim, 0, relative=True, **kwargs)
        self.motion_dim = self.reader.num_features - state_dim
        self.latent_dim = num_features + self.motion_dim + (state_dim if position_weight else 0)
        self.position_weight = position_weight / math.sqrt(state_dim)
        self.num_features, self.kernels = num_features, dict(kernels)
        self.blocks = tuple(kernels) if num_features else ("",)
        first = self._numbers(next(iter(kernels)))
        if len(self.blocks) > 1:  # stored with the weights, which hold a decoder for the chosen kernel
            self.register_buffer("kernel", torch.tensor(first))
        else:
            self.kernel = first
        shapes = {"frequency": (self.motion_dim + state_dim, num_features), "phase": (num_features,)}
        for name, shape in shapes.items():
            if trainable:
                self.register_parameter(name, nn.Parameter(torch.empty(shape)))
            else:
                self.register_buffer(name, torch.empty(shape))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws frequencies and phases of the squared-exponential kernel anew."""
        nn.init.normal_(self.frequency)
        nn.init.uniform_(self.phase, 0.0, 2 * math.pi)

    def _numbers(self, name: str) -> tuple[float, float, float]:
        """Returns the amplitude of the features and both length scales of a kernel."""
        curvature, motion_scale, position_scale = self.kernels[name]
        return math.sqrt(2 * curvature / max(self.num_features, 1)), motion_scale, position_scale

    @torch.no_grad()
    def choose(self, block: str) -> None:
        """Selects the kernel of this name, if there are several."""
        if isinstance(self.kernel, Tensor):
            self.kernel.copy_(self.kernel.new_tensor(self._numbers(block)))

    def infer(self, read: Tensor) -> Tensor:
        """Evaluates the observables ``[*B, T, m]``."""
        n = self.reader.num_past
        present = read[..., n, :]
        motion = torch.cat([read[..., :n, :], read[..., n + 1 :, :]], -2).flatten(-2) / math.sqrt(self.motion_dim)
        amplitude, motion_scale, position_scale = self.kernel
        where = torch.cat([motion / motion_scale, present / position_scale], -1)
        curved = amplitude * torch.cos(where @ self.frequency + self.phase)
        parts = [motion, curved]
        if self.position_weight:
            parts.append(self.position_weight * present)
        return torch.cat(parts, -1)

    def axis_features(self, axes: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Returns the entries that hold the steps along state columns (:meth:`LatentActionModule.axis_features`)."""
        n, axes = self.reader.num_past, list(axes)
        scales = torch.cat([self.reader.scales[:n], self.reader.scales[n + 1 :]])[:, axes]
        first = torch.arange(len(scales), device=scales.device)[:, None] * self.state_dim
        return first + torch.tensor(axes, device=scales.device), scales * math.sqrt(self.motion_dim)


class LinearActionDecoder(TensorDictModuleBase):
    r"""Decodes latent actions linearly: :math:`a_t = D u_t + b`.

    ``D`` is ``linear.weight``, ``[act, m]``; ``b`` is ``linear.bias``, ``[act]``.

    Args:
        latent_dim (int): size ``m`` of a latent action.
        action_dim (int): size of an action.

    Keyword Args:
        in_key, out_key (NestedKey): latent actions ``[*B, T, m]``, and actions ``[*B, T, act]`` in normalised units.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import LinearActionDecoder, ridge
        >>> decoder, latent = LinearActionDecoder(4, 2), torch.randn(50, 4)
        >>> decoder.assign(ridge(latent, latent[:, :2]))
        >>> td = decoder(TensorDict({"latent_action": latent}, [50]))
        >>> bool((td["action"] - latent[:, :2]).abs().max() < 1e-3)
        True
    """

    def __init__(
        self, latent_dim: int, action_dim: int, *, in_key: NestedKey = LATENT_ACTION, out_key: NestedKey = ACTION
    ):
        super().__init__()
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.linear = nn.Linear(latent_dim, action_dim)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the decoded actions."""
        return tensordict.set(self.out_keys[0], self.linear(read_entry(self, tensordict, self.in_keys[0])))

    @torch.no_grad()
    def assign(self, fit: RidgeFit) -> None:
        """Copies the weights of a ridge regression from latent actions to normalised actions.

        Raises:
            ValueError: if the regression has another number of input or output columns.
        """
        if fit.weight.shape != self.linear.weight.shape:
            wanted, found = (list(weight.shape) for weight in (self.linear.weight, fit.weight))
            raise ValueError(f"the decoder's weights are {wanted} [action, latent], those of the labels {found}")
        self.linear.weight.copy_(fit.weight)
        self.linear.bias.copy_(fit.bias)
