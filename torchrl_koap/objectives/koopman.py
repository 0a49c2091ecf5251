# This source code is licensed under the MIT license found in the LICENSE file.
r"""Losses of the Koopman inverse dynamics model.

.. math::
    L = L_{recon} + \lambda_1 L_{kpm} + \lambda_2 L_a, \quad
    L_{recon} = \overline{|g_\psi(g_\theta(x_t)) - x_t|^2}, \quad
    L_{kpm} = \overline{|K g(x_t) + u_t - g(x_{t+1})|^2}, \quad
    L_a = \overline{|D u_t + b - a_t|^2}

All residuals are in normalised units. ``L_a`` averages over the labelled frames alone; a batch
without labels gives exactly 0, and an unlabelled (NaN) action reaches neither value nor gradient.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from torch import Tensor

from torchrl_koap.modules.koopman.inverse_dynamics import KoopmanInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class _KoopmanLoss(WindowLoss):
    """What the four losses share: the network, and one pass that computes the wanted terms."""

    network: KoopmanInverseDynamics
    network_params: TensorDictParams
    target_network_params: TensorDictParams

    def __init__(self, network: KoopmanInverseDynamics, *, reduction: str = "mean"):
        super().__init__(network, reduction=reduction)

    def _reconstruction(self, state: Tensor, lifted: Tensor) -> Tensor:
        error = self.network.lifting.reconstruction_error(lifted, self.network.normalize_state(state))
        return self._reduce(error, torch.ones_like(error, dtype=torch.bool))

    def _latent(self, state: Tensor) -> tuple[Tensor, range]:
        span = self.network.latent_action.span(state.shape[-2])
        return self.network.infer(state, span), span

    def _dynamics(self, lifted: Tensor, latent: Tensor, span: range, recorded: Tensor) -> Tensor:
        predicted = self.network.predict_next(lifted[..., span.start : span.stop, :], latent)
        error = (predicted - lifted[..., span.start + 1 : span.stop + 1, :]).square().mean(-1)
        return self._reduce(error, recorded[..., span.start : span.stop])

    def _action(
        self, tensordict: TensorDictBase, state: Tensor, latent: Tensor, span: range, recorded: Tensor
    ) -> Tensor:
        target, counts = self._targets(tensordict, state, recorded, span)
        return self._reduce(self._action_error(self.network.action_decoder.linear(latent), target), counts)


class KoopmanReconstructionLoss(_KoopmanLoss):
    """Error of lifting and mapping back, ``loss_reconstruction``, over all frames of the window.

    Args:
        network (KoopmanInverseDynamics): the model.

    Keyword Args:
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, T]``).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> from torchrl_koap.objectives import KoopmanReconstructionLoss
        >>> loss = KoopmanReconstructionLoss(make_koopman_inverse_dynamics(2, 2, latent_dim=8))
        >>> loss(TensorDict({"state": torch.randn(4, 16, 2)}, [4]))["loss_reconstruction"].shape
        torch.Size([])
    """

    out_keys = ["loss_reconstruction"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``."""
        state, _ = self._inputs(tensordict)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            loss = self._reconstruction(state, self.network.lift(state))
        return TensorDict({"loss_reconstruction": loss})


class KoopmanDynamicsLoss(_KoopmanLoss):
    """One-step error of the linear latent dynamics, ``loss_koopman``, over the frames that count.

    Which frames count: :meth:`LatentActionModule.span`.

    Args:
        network (KoopmanInverseDynamics): the model.

    Keyword Args:
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, frames]``, 0 where masked).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> from torchrl_koap.objectives import KoopmanDynamicsLoss
        >>> loss = KoopmanDynamicsLoss(make_koopman_inverse_dynamics(2, 2, latent_dim=8))
        >>> loss(TensorDict({"state": torch.randn(4, 16, 2)}, [4]))["loss_koopman"].shape
        torch.Size([])
    """

    out_keys = ["loss_koopman"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``."""
        state, recorded = self._inputs(tensordict)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            loss = self._dynamics(self.network.lift(state), *self._latent(state), recorded)
        return TensorDict({"loss_koopman": loss})


class LatentActionLoss(_KoopmanLoss):
    """Error of the decoded actions, ``loss_action``, over the labelled frames that count.

    A batch without labels gives exactly 0, and exactly zero gradients.

    Args:
        network (KoopmanInverseDynamics): the model.

    Keyword Args:
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, frames]``, 0 where unlabelled).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> from torchrl_koap.objectives import LatentActionLoss
        >>> loss = LatentActionLoss(make_koopman_inverse_dynamics(2, 2, latent_dim=8))
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.full((4, 16, 2), torch.nan),
        ...                     "has_action": torch.zeros(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].item()
        0.0
    """

    out_keys = ["loss_action"]
    uses_labels = True

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``, ``action`` and ``has_action``."""
        state, recorded = self._inputs(tensordict)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            loss = self._action(tensordict, state, *self._latent(state), recorded)
        return TensorDict({"loss_action": loss})


class KOAPLoss(_KoopmanLoss):
    """Weighted sum of the three terms, from one pass through the networks.

    The coefficients are already applied to the returned terms, so their sum is the total.

    Args:
        network (KoopmanInverseDynamics): the model.

    Keyword Args:
        koopman_coeff (float): ``lambda_1``. Defaults to ``1``. Assigning to it later is an in-place buffer write.
        action_coeff (float): ``lambda_2``. Defaults to ``1``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> from torchrl_koap.objectives import KOAPLoss
        >>> loss = KOAPLoss(make_koopman_inverse_dynamics(2, 2, latent_dim=8))
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.full((4, 16, 2), torch.nan),
        ...                     "has_action": torch.zeros(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].item()
        0.0
    """

    out_keys = ["loss_reconstruction", "loss_koopman", "loss_action"]
    uses_labels = True
    _schedulable_buffers = frozenset({"koopman_coeff", "action_coeff"})

    def __init__(
        self,
        network: KoopmanInverseDynamics,
        *,
        koopman_coeff: float = 1.0,
        action_coeff: float = 1.0,
        reduction: str = "mean",
    ):
        super().__init__(network, reduction=reduction)
        self.register_coeff_buffer("koopman_coeff", koopman_coeff)
        self.register_coeff_buffer("action_coeff", action_coeff)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the three terms from ``state``, ``action`` and ``has_action``."""
        state, recorded = self._inputs(tensordict)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            lifted, (latent, span) = self.network.lift(state), self._latent(state)
            losses = {
                "loss_reconstruction": self._reconstruction(state, lifted),
                "loss_koopman": self.koopman_coeff * self._dynamics(lifted, latent, span, recorded),
                "loss_action": self.action_coeff * self._action(tensordict, state, latent, span, recorded),
            }
        return TensorDict(losses)
