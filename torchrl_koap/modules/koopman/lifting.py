# This source code is licensed under the MIT license found in the LICENSE file.
"""Lifting to a space with linear dynamics, and the linear operator that lives there."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_koap.keys import LATENT_ACTION, LIFTED_STATE, STATE
from torchrl_koap.lookup import lookup
from torchrl_koap.modules.networks import SequenceLSTM

STRUCTURES = ("dense", "diagonal", "block_diagonal")
INITS = ("identity", "normal")


class KoopmanLifting(TensorDictModuleBase):
    r"""Lifts states to observables with linear dynamics, and maps them back.

    .. math::
        z_t = g_\theta(x_t), \qquad \hat x_t = g_\psi(z_t)

    ``forward`` writes the lifted states; :meth:`decode` is used by the reconstruction loss.

    Args:
        state_dim (int): size ``d`` of a state.
        latent_dim (int): size ``m`` of a lifted state.

    Keyword Args:
        hidden_dims (sequence of int): widths of both networks. Defaults to ``(128, 128)``.
        include_state (bool): the first ``d`` observables are the state itself, as in extended dynamic mode
            decomposition; the other ``m - d`` are learned. Defaults to ``False``.
        recurrent (bool): use one LSTM layer and a linear map in both directions, so that ``z_t`` depends on
            ``x_0..x_t`` (the released code; the paper's ``g`` is a function of ``x_t`` alone). Defaults to ``False``.
        linear_skip (bool): add a linear map in both directions, which :meth:`fit_linear` sets to the principal
            components, so that a nearly linear lifting costs the networks nothing. Defaults to ``False``.
        in_key (NestedKey): states ``[*B, T, d]``. Defaults to ``"state"``.
        out_key (NestedKey): lifted states ``[*B, T, m]``. Defaults to ``"lifted_state"``.

    Raises:
        ValueError: if ``include_state`` is asked for with ``latent_dim < state_dim`` or together with ``recurrent``, or
            ``linear_skip`` with either.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import KoopmanLifting
        >>> lifting = KoopmanLifting(2, 8, include_state=True)
        >>> td = lifting(TensorDict({"state": torch.randn(5, 16, 2)}, [5]))
        >>> td["lifted_state"].shape
        torch.Size([5, 16, 8])
        >>> bool((td["lifted_state"][..., :2] == td["state"]).all())
        True
    """

    unfolds = False  # whether unfold() trains anything

    def __init__(
        self,
        state_dim: int,
        latent_dim: int,
        *,
        hidden_dims: Sequence[int] = (128, 128),
        include_state: bool = False,
        recurrent: bool = False,
        linear_skip: bool = False,
        in_key: NestedKey = STATE,
        out_key: NestedKey = LIFTED_STATE,
    ):
        super().__init__()
        if include_state and recurrent:
            raise ValueError("include_state needs a lifting of single states; a recurrent one has no such columns")
        if include_state and latent_dim < state_dim:
            raise ValueError(f"include_state needs latent_dim >= state_dim, got {latent_dim} < {state_dim}")
        if linear_skip and (include_state or recurrent):
            raise ValueError("linear_skip is for a learned lifting of single states, not include_state or recurrent")
        self.in_keys, self.out_keys = [in_key], [out_key]
        self.state_dim, self.latent_dim, self.include_state = state_dim, latent_dim, include_state
        learned = latent_dim - state_dim if include_state else latent_dim
        if recurrent:
            self.encoder = SequenceLSTM(state_dim, hidden_dims[0], latent_dim)
            self.decoder = SequenceLSTM(latent_dim, hidden_dims[0], state_dim)
        else:
            self.encoder = MLP(state_dim, learned, num_cells=hidden_dims, activation_class=nn.ReLU) if learned else None
            self.decoder = MLP(latent_dim, state_dim, num_cells=hidden_dims, activation_class=nn.ReLU)
        self.encoder_skip = nn.Linear(state_dim, latent_dim, bias=False) if linear_skip else None
        self.decoder_skip = nn.Linear(latent_dim, state_dim, bias=False) if linear_skip else None

    @property
    def keeps_state(self) -> bool:
        """Whether the lifted state is the state itself and nothing else."""
        return self.encoder is None

    def fit_unlabelled(self, windows: Tensor) -> None:
        """Sets what is known before training from unlabelled windows ``[*B, T, d]``: the linear maps, if it has any."""
        if self.encoder_skip is not None:
            self.fit_linear(windows)

    def unfold(self, windows: Tensor, updates: int = 0, progress: Callable[[int, int], None] | None = None) -> None:
        """Trains what is trained before the losses are, on unlabelled windows ``[*B, T, d]``: here nothing."""

    def choose_size(self, windows: Tensor) -> int:
        """Number of coordinates kept after training, chosen on unlabelled windows ``[*B, T, d]``: here all."""
        return self.latent_dim

    @torch.no_grad()
    def fit_linear(self, states: Tensor) -> None:
        """Sets the linear maps to the principal components of states ``[*B, d]``, at unit spread; no label is read.

        Raises:
            ValueError: if the lifting has no linear maps.
        """
        if self.encoder_skip is None:
            raise ValueError("fit_linear needs a lifting with linear_skip=True")
        states = states.flatten(0, -2).double()
        centred = states - states.mean(0)
        values, vectors = torch.linalg.eigh(centred.mT @ centred / len(centred))
        count = min(self.latent_dim, self.state_dim)
        components, spread = vectors[:, -count:].flip(-1), values[-count:].flip(-1).clamp_min(1e-12).sqrt()
        components = components * torch.where(components.sum(0) < 0, -1.0, 1.0)  # their sign is the solver's whim
        self.encoder_skip.weight.zero_()[:count] = (components / spread).mT.to(self.encoder_skip.weight)
        self.decoder_skip.weight.zero_()[:, :count] = (components * spread).to(self.decoder_skip.weight)

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
        """Mean squared error ``[*B, T]`` of mapping lifted states ``[*B, T, m]`` back to states ``[*B, T, d]``."""
        return (self.decode(lifted) - state).square().mean(-1)

    def forward(self, tensordict):
        """Writes the lifted states."""
        return tensordict.set(self.out_keys[0], self.encode(tensordict.get(self.in_keys[0])))


class KoopmanOperator(TensorDictModuleBase):
    r"""The linear operator with a latent action.

    .. math::
        z_{t+1} = K z_t + u_t \quad\text{or, with an input matrix,}\quad z_{t+1} = K z_t + B u_t

    Args:
        latent_dim (int): size ``m`` of a lifted state (and of a latent action, without an input matrix).

    Keyword Args:
        input_dim (int, optional): size ``p`` of a latent action; adds the matrix ``B`` ``[m, p]``, zero at first.
            Default: no ``B``, as in the paper. With ``B`` a latent action may hold more than the next state shows.
        structure (str): ``"dense"`` (paper), ``"diagonal"`` (released code) or ``"block_diagonal"``.
        block_dim (int): size of a block of a block-diagonal operator. Defaults to ``2``, which can hold one
            complex pair of eigenvalues.
        max_spectral_radius (float, optional): bound on ``max |eigenvalue|``. The matrix is scaled down where its
            spectral norm, an upper bound of the radius, exceeds it. Default: no bound.
        init (str): ``"identity"`` (plus small noise) or ``"normal"`` (released code). Defaults to ``"identity"``.
        in_keys (sequence of NestedKey): lifted state ``[*B, T, m]`` and latent action ``[*B, T, m or p]``.
        out_key (NestedKey): predicted next lifted state ``[*B, T, m]``.

    Raises:
        ValueError: for an unknown structure or init, a ``latent_dim`` that ``block_dim`` does not divide, or a
            bound that is not positive.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import KoopmanOperator
        >>> operator = KoopmanOperator(4, structure="block_diagonal", max_spectral_radius=1.0)
        >>> operator.matrix().shape, bool((operator.eigenvalues().abs() <= 1 + 1e-6).all())
        (torch.Size([4, 4]), True)
    """

    def __init__(
        self,
        latent_dim: int,
        *,
        input_dim: int | None = None,
        structure: str = "dense",
        block_dim: int = 2,
        max_spectral_radius: float | None = None,
        init: str = "identity",
        in_keys: Sequence[NestedKey] = (LIFTED_STATE, LATENT_ACTION),
        out_key: NestedKey = ("next", LIFTED_STATE),
    ):
        super().__init__()
        lookup(STRUCTURES, structure, "operator structure")
        lookup(INITS, init, "operator init")
        if max_spectral_radius is not None and not max_spectral_radius > 0:
            raise ValueError(f"max_spectral_radius must be positive, got {max_spectral_radius}")
        if block_dim < 1:
            raise ValueError(f"block_dim must be at least 1, got {block_dim}")
        if structure == "block_diagonal" and latent_dim % block_dim:
            raise ValueError(f"latent_dim {latent_dim} is not a multiple of block_dim {block_dim}")
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        self.latent_dim, self.structure, self.block_dim = latent_dim, structure, block_dim
        self.max_spectral_radius, self.init = max_spectral_radius, init
        shapes = {
            "dense": (latent_dim, latent_dim),
            "diagonal": (latent_dim,),
            "block_diagonal": (latent_dim // block_dim, block_dim, block_dim),
        }
        self.weight = nn.Parameter(torch.empty(shapes[structure]))
        self.input_dim = latent_dim if input_dim is None else input_dim
        self.input = None if input_dim is None else nn.Parameter(torch.zeros(latent_dim, input_dim))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draws the operator anew."""
        with torch.no_grad():
            if self.input is not None:
                self.input.zero_()
            if self.init == "normal":
                self.weight.normal_()
                return
            self.weight.normal_(std=1e-3)
            if self.structure == "diagonal":
                self.weight.add_(1.0)
            else:
                self.weight.add_(torch.eye(self.weight.shape[-1], dtype=self.weight.dtype, device=self.weight.device))

    def _bounded_weight(self) -> Tensor:
        if self.max_spectral_radius is None:
            return self.weight
        if self.structure == "diagonal":
            norm = self.weight.abs()
        else:
            norm = torch.linalg.matrix_norm(self.weight, ord=2)[..., None, None]
        return self.weight * (self.max_spectral_radius / norm.clamp_min(self.max_spectral_radius))

    def matrix(self) -> Tensor:
        """The operator as a matrix ``K`` of shape ``[m, m]``."""
        weight = self._bounded_weight()
        if self.structure == "dense":
            return weight
        if self.structure == "diagonal":
            return weight.diag_embed()
        return torch.block_diag(*weight)

    def eigenvalues(self) -> Tensor:
        """Eigenvalues of ``K``, complex ``[m]``, largest modulus first."""
        weight = self._bounded_weight().detach()
        if self.structure == "diagonal":
            values = weight.to(torch.complex128 if weight.dtype == torch.float64 else torch.complex64)
        else:
            values = torch.linalg.eigvals(weight).flatten()
        return values[values.abs().argsort(descending=True)]

    def propagate(self, lifted: Tensor) -> Tensor:
        """The autonomous part ``K z`` for lifted states ``[*B, T, m]``."""
        weight = self._bounded_weight()
        if self.structure == "dense":
            return lifted @ weight.mT
        if self.structure == "diagonal":
            return lifted * weight
        blocks = lifted.unflatten(-1, (-1, self.block_dim))  # [*B, T, m / b, b]
        return torch.einsum("nij,...nj->...ni", weight, blocks).flatten(-2)

    def step(self, lifted: Tensor, latent_action: Tensor) -> Tensor:
        """One step ``K z + u``, or ``K z + B u`` where the operator has an input matrix.

        Args:
            lifted (Tensor): lifted states ``z``, ``[*B, T, m]``.
            latent_action (Tensor): latent actions ``u``, ``[*B, T, input_dim]``.

        Returns:
            Tensor: lifted states one step later, ``[*B, T, m]``.
        """
        return self.propagate(lifted) + (latent_action if self.input is None else latent_action @ self.input.mT)

    def forward(self, tensordict):
        """Writes the predicted next lifted state."""
        lifted, latent_action = (tensordict.get(key) for key in self.in_keys)
        return tensordict.set(self.out_keys[0], self.step(lifted, latent_action))
