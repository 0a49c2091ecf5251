# This source code is licensed under the MIT license found in the LICENSE file.
r"""Losses of the Koopman inverse dynamics model.

.. math::
    L = L_{recon} + \lambda_1 L_{kpm} + \lambda_2 L_a, \quad
    L_{recon} = \overline{|g_\psi(g_\theta(x_t)) - x_t|^2}, \quad
    L_{kpm} = \overline{|K g(x_t) + u_t - g(x_{t+1})|^2}, \quad
    L_a = \overline{|D u_t + b - a_t|^2}

All residuals are in normalised units; ``|.|^2`` is the mean square over their columns. ``L_a`` averages over the
labelled frames only. A batch without labels gives exactly 0; unlabelled (NaN) actions affect neither value nor
gradient.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch
from torch import Tensor

from torchrl_koap.modules.koopman.inverse_dynamics import KoopmanInverseDynamics, LiftedInverseDynamics
from torchrl_koap.objectives.base import WindowLoss

RECONSTRUCTION, KOOPMAN, ACTION = "loss_reconstruction", "loss_koopman", "loss_action"


class _KoopmanLoss(WindowLoss):
    """Computes the terms named by its out-keys in one pass through the networks."""

    trains = (KoopmanInverseDynamics, LiftedInverseDynamics)
    network: LiftedInverseDynamics

    def _terms(self, tensordict: TensorDictBase) -> dict[str, Tensor]:
        network, wanted = self.network, self.out_keys_source  # all out-keys, even if only some are selected
        state, recorded = self._inputs(tensordict)
        found = {}
        with self.network_params.to_module(network, preserve_module_state=False):
            if {RECONSTRUCTION, KOOPMAN} & set(wanted):
                lifted = network.lift(state)
            if {KOOPMAN, ACTION} & set(wanted):
                span = network.valid_frames(state.shape[-2])
                latent = network.infer(state, span)
            if RECONSTRUCTION in wanted:
                error = network.lifting.reconstruction_error(lifted, network.normalize_state(state))
                found[RECONSTRUCTION] = self._reduce(error, torch.ones_like(error, dtype=torch.bool))
            if KOOPMAN in wanted:
                predicted = network.predict_next(lifted[..., span.start : span.stop, :], latent)
                error = (predicted - lifted[..., span.start + 1 : span.stop + 1, :]).square().mean(-1)
                errors = {KOOPMAN: error} | self.further_errors(lifted, latent)
                counts = recorded[..., span.start : span.stop]
                found |= {name: self._reduce(error, counts) for name, error in errors.items()}
            if ACTION in wanted:
                target, counts = self._targets(tensordict, state, recorded, span)
                found[ACTION] = self._reduce(self._action_error(network.decode(latent), target), counts)
        return found

    def further_errors(self, lifted: Tensor, latent: Tensor) -> dict[str, Tensor]:
        """Computes errors of a subclass, by the ``loss_*`` names that its ``out_keys`` list after the three others.

        They are ``[*B, frames]``, or a number, and reduced as those of the dynamics. Lifted states are ``[*B, T, m]``,
        latent actions ``[*B, frames, p]``, those of the network's ``valid_frames(T)``. Here there are none.
        """
        return {}

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state`` and, for the action term, ``action`` and ``has_action``."""
        return TensorDict(self._terms(tensordict))


class KoopmanReconstructionLoss(_KoopmanLoss):
    """Computes the error of lifting and mapping back, ``loss_reconstruction``, over all frames of the window.

    Args:
        network (KoopmanInverseDynamics or NonlinearInverseDynamics): the model.

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

    out_keys = [RECONSTRUCTION]


class KoopmanDynamicsLoss(_KoopmanLoss):
    """Computes the one-step error of the latent dynamics, ``loss_koopman``, over the frames that count.

    Args as of :class:`KoopmanReconstructionLoss`; with ``"none"`` the loss is ``[*B, frames]``, 0 where masked.

    Examples:
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> from torchrl_koap.objectives import KoopmanDynamicsLoss
        >>> KoopmanDynamicsLoss(make_koopman_inverse_dynamics(2, 2)).in_keys
        ['state']
    """

    out_keys = [KOOPMAN]


class LatentActionLoss(_KoopmanLoss):
    """Computes the error of the decoded actions, ``loss_action``, over the labelled frames that count.

    Args as of :class:`KoopmanDynamicsLoss`.

    Examples:
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> from torchrl_koap.objectives import LatentActionLoss
        >>> LatentActionLoss(make_koopman_inverse_dynamics(2, 2)).in_keys
        ['state', 'action', 'has_action']
    """

    out_keys = [ACTION]
    required = ("state", "action", "has_action")


class KOAPLoss(_KoopmanLoss):
    """Computes the three terms in one pass through the networks, coefficients applied; their sum is the total loss.

    The reconstruction term averages over all frames, the dynamics term over :meth:`InverseDynamics.valid_frames`, the
    action term over the labelled ones of these. A subclass adds terms by :meth:`further_errors`.

    Args:
        network (KoopmanInverseDynamics or NonlinearInverseDynamics): the model.

    Keyword Args:
        koopman_coeff (float): ``lambda_1``. Defaults to ``1``. Later assignments write to the buffer in place.
        action_coeff (float): ``lambda_2``. Defaults to ``1``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, T]``, other terms ``[*B, frames]``).

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

    out_keys = [RECONSTRUCTION, KOOPMAN, ACTION]
    required = ("state", "action", "has_action")
    _schedulable_buffers = frozenset({"koopman_coeff", "action_coeff"})

    def __init__(
        self,
        network: LiftedInverseDynamics,
        *,
        koopman_coeff: float = 1.0,
        action_coeff: float = 1.0,
        reduction: str = "mean",
    ):
        super().__init__(network, reduction=reduction)
        self.register_coeff_buffer("koopman_coeff", float(koopman_coeff))
        self.register_coeff_buffer("action_coeff", float(action_coeff))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the three terms from ``state``, ``action`` and ``has_action``."""
        terms = self._terms(tensordict)
        terms[KOOPMAN] = self.koopman_coeff * terms[KOOPMAN]
        terms[ACTION] = self.action_coeff * terms[ACTION]
        return TensorDict(terms)
