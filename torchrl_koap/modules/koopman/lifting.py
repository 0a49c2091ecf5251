# This source code is licensed under the MIT license found in the LICENSE file.
"""The linear model: observables of states (lifting), and the operator ``K`` that advances them by one step."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.keys import LATENT_ACTION, LIFTED_STATE, STATE, read_entry


class KoopmanLifting(TensorDictModuleBase):
    r"""Lifts states to observables with linear dynamics, and maps them back.

    .. math::
        z_t = g_\theta(x_t), \qquad \hat x_t = g_\psi(z_t)

    ``forward`` writes the lifted states; :meth:`decode` is used by the reconstruction loss.

    Args:
        state_dim (int): size ``d`` of a state.
        latent_dim (int): size ``m`` of a lifted state.

    Keyword Args:
        hidden_dims (sequence of int): widths of both networks.
        include_state (bool): the first ``d`` observables are the state itself, as in extended dynamic mode
            decomposition; the other ``m - d`` are learned.
        linear_skip (bool): add linear maps to a learned lifting, in both directions. :meth:`prepare` sets them to the
            principal components, so that the networks need only learn the nonlinear part.
        in_key, out_key (NestedKey): states ``[*B, T, d]`` and lifted states ``[*B, T, m]``.

    Raises:
        ValueError: for ``include_state`` with ``latent_dim < state_dim`` or together with ``linear_skip``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import KoopmanLifting
        >>> lifting = KoopmanLifting(2, 8, include_state=True)
        >>> td = lifting(TensorDict({"state": torch.randn(5, 16, 2)}, [5]))
        >>> td["lifted_state"].shape, bool((td["lifted_state"][..., :2] == td["state"]).all())
        (torch.Size([5, 16, 8]), True)
    """

    def __init__(
        self,
        state_dim: int,
        latent_dim: int,
        *,
        hidden_dims: Sequence[int] = (128, 128),
        include_state: bool = False,
        linear_skip: bool = False,
        in_key: NestedKey = STATE,
        out_key: NestedKey = LIFTED_STATE,
    ):
        super().__init__()
        if include_state and latent_dim < state_dim:
            raise ValueError(f"include_state needs latent_dim >= state_dim, got {latent_dim} < {state_dim}")
        if linear_skip and include_state:
            raise ValueError("linear_skip is for a learned lifting, not include_state")
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.state_dim, self.latent_dim, self.include_state = state_dim, latent_dim, include_state
        learned = latent_dim - state_dim if include_state else latent_dim
        self.encoder = MLP(state_dim, learned, num_cells=hidden_dims, activation_class=nn.ReLU) if learned else None
        self.decoder = MLP(latent_dim, state_dim, num_cells=hidden_dims, activation_class=nn.ReLU)
        self.encoder_skip = nn.Linear(state_dim, latent_dim, bias=False) if linear_skip else None
        self.decoder_skip = nn.Linear(latent_dim, state_dim, bias=False) if linear_skip else None

    @property
    def keeps_state(self) -> bool:
        """Whether the lifted state equals the state."""
        return self.encoder is None

    @torch.no_grad()
    def prepare(self, windows: Tensor) -> None:
        """Sets the linear maps, if there are any, to the principal components of states ``[*B, d]`` at unit spread."""
        if self.encoder_skip is None:
            return
        states = windows.flatten(0, -2).double()
        centred = states - states.mean(0)
        values, vectors = torch.linalg.eigh(centred.mT @ centred / len(centred))
        count = min(self.latent_dim, self.state_dim)
        components, spread = vectors[:, -count:].flip(-1), values[-count:].flip(-1).clamp_min(1e-12).sqrt()
        components = components * torch.where(components.sum(0) < 0, -1.0, 1.0)  # their sign is arbitrary
        self.encoder_skip.weight.zero_()[:count] = (components / spread).mT.to(self.encoder_skip.weight)
        self.decoder_skip.weight.zero_()[:, :count] = (components * spread).to(self.decoder_skip.weight)

    def pretrain(self, windows: Tensor, updates: int, progress: Callable[[int, int], None] | None = None) -> None:
        """Trains on windows ``[*B, T, d]`` before the losses (:meth:`InverseDynamics.prepare`); does nothing here."""

    def finish(self, windows: Tensor) -> None:
        """Chooses coordinates after training, on windows ``[*B, T, d]`` without labels; keeps all of them here."""

    def encode(self, state: Tensor) -> Tensor:
        """Lifts states ``[*B, T, d]`` to ``[*B, T, m]``."""
        if state.shape[-1] != self.state_dim:
            raise ValueError(f"expected states with {self.state_dim} columns, got shape {list(state.shape)}")
        if not self.include_state:
            lifted = self.encoder(state)
            return lifted if self.encoder_skip is None else lifted + self.encoder_skip(state)
        if self.encoder is None:
            return state
        return torch.cat([state, self.encoder(state)], -1)

    def decode(self, lifted: Tensor) -> Tensor:
        """Maps lifted states ``[*B, T, m]`` back to ``[*B, T, d]``."""
        state = self.decoder(lifted)
        return state if self.decoder_skip is None else state + self.decoder_skip(lifted)

    def reconstruction_error(self, lifted: Tensor, state: Tensor) -> Tensor:
        """Computes the mean squared error ``[*B, T]`` of states mapped back from lifted ones ``[*B, T, m]``."""
        decoded = self.decode(lifted)
        if decoded.shape != state.shape:
            raise ValueError(f"decode must return {list(state.shape)} ([*B, T, d]), got {list(decoded.shape)}")
        return (decoded - state).square().mean(-1)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the lifted states."""
        return tensordict.set(self.out_keys[0], self.encode(read_entry(self, tensordict, self.in_keys[0])))


class KoopmanOperator(TensorDictModuleBase):
    r"""Advances lifted states by one step, with a dense matrix and a latent action.

    .. math::
        z_{t+1} = K z_t + u_t \quad\text{or, with an input matrix,}\quad z_{t+1} = K z_t + B u_t

    ``K`` is ``weight``, ``[m, m]``; ``B`` is ``input``, ``[m, p]`` or None.

    Args:
        latent_dim (int): size ``m`` of a lifted state (and of a latent action, without an input matrix).

    Keyword Args:
        input_dim (int, optional): size ``p`` of a latent action; adds the matrix ``B`` ``[m, p]``, zero at first.
            Default: no ``B``, as in the paper. With ``B`` a latent action may hold more than the next state reveals.
        in_keys (sequence of NestedKey): lifted state ``[*B, T, m]`` and latent action ``[*B, T, m or p]``.
        out_key (NestedKey): predicted next lifted state ``[*B, T, m]``. In a ``ModelBasedEnvBase`` of TorchRL it is
            ``"lifted_state"``; with the default the environment ignores the prediction and stands still.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import KoopmanOperator
        >>> operator = KoopmanOperator(4, input_dim=6)
        >>> td = TensorDict({"lifted_state": torch.randn(5, 16, 4), "latent_action": torch.randn(5, 16, 6)}, [5, 16])
        >>> operator(td)["next", "lifted_state"].shape, operator.eigenvalues().shape
        (torch.Size([5, 16, 4]), torch.Size([4]))
    """

    def __init__(
        self,
        latent_dim: int,
        *,
        input_dim: int | None = None,
        in_keys: Sequence[NestedKey] = (LIFTED_STATE, LATENT_ACTION),
        out_key: NestedKey = ("next", LIFTED_STATE),
    ):
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        self.latent_dim, self.input_dim = latent_dim, latent_dim if input_dim is None else input_dim
        self.weight = nn.Parameter(torch.empty(latent_dim, latent_dim))
        self.input = None if input_dim is None else nn.Parameter(torch.zeros(latent_dim, input_dim))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draws ``K`` near the identity, and sets ``B`` to zero."""
        if self.input is not None:
            self.input.zero_()
        self.weight.normal_(std=1e-3).add_(torch.eye(self.latent_dim).to(self.weight))

    def eigenvalues(self) -> Tensor:
        """Computes the eigenvalues of ``K``, complex ``[m]``, largest modulus first."""
        values = torch.linalg.eigvals(self.weight.detach())
        return values[values.abs().argsort(descending=True)]

    def step(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """Computes lifted states ``[*B, T, m]`` one step later, ``K z + u``, or ``K z + B u`` with an input matrix."""
        following = lifted @ self.weight.mT
        return following + (latent_action if self.input is None else latent_action @ self.input.mT)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the predicted next lifted state."""
        lifted, latent_action = (read_entry(self, tensordict, key, "in_keys=...") for key in self.in_keys)
        return tensordict.set(self.out_keys[0], self.step(lifted, latent_action))
