# This source code is licensed under the MIT license found in the LICENSE file.
r"""The loss of KOAP with nonlinear latent dynamics and a nonlinear action decoder.

.. math::
    L = \overline{|g_\psi(z_t) - x_t|^2} + \lambda_1 \overline{|h(z_t, u_t) - z_{t+1}|^2}
        + \lambda_2 \overline{|d_\phi(u_t) - a_t|^2}
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from torch import Tensor

from torchrl_koap.modules.baselines.nonlinear import NonlinearInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class NonlinearLoss(WindowLoss):
    """Weighted sum of reconstruction, latent dynamics and actions, as :class:`~torchrl_koap.objectives.KOAPLoss`.

    The coefficients are already applied to the returned terms, so their sum is the total. As there, the reconstruction
    averages over all frames, the dynamics over those of :meth:`NonlinearInverseDynamics.span`, the actions over the
    labelled ones of these; a batch without labels gives exactly 0, and an unlabelled (NaN) action reaches neither value
    nor gradient.

    Args:
        network (NonlinearInverseDynamics): the model.

    Keyword Args:
        dynamics_coeff (float): ``lambda_1``. Defaults to ``1``. Assigning to it later is an in-place buffer write.
        action_coeff (float): ``lambda_2``. Defaults to ``1``.
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, T]``, then twice ``[*B, frames]``).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import NonlinearInverseDynamics
        >>> from torchrl_koap.objectives import NonlinearLoss
        >>> loss = NonlinearLoss(NonlinearInverseDynamics(2, 2))
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.full((4, 16, 2), torch.nan),
        ...                     "has_action": torch.zeros(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].item()
        0.0
    """

    network: NonlinearInverseDynamics
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    out_keys = ["loss_reconstruction", "loss_dynamics", "loss_action"]
    uses_labels = True
    _schedulable_buffers = frozenset({"dynamics_coeff", "action_coeff"})

    def __init__(
        self,
        network: NonlinearInverseDynamics,
        *,
        dynamics_coeff: float = 1.0,
        action_coeff: float = 1.0,
        reduction: str = "mean",
    ):
        super().__init__(network, reduction=reduction)
        self.register_coeff_buffer("dynamics_coeff", dynamics_coeff)
        self.register_coeff_buffer("action_coeff", action_coeff)

    def _reconstruction(self, state: Tensor, lifted: Tensor) -> Tensor:
        error = (self.network.lifting.decode(lifted) - self.network.normalize_state(state)).square().mean(-1)
        return self._reduce(error, torch.ones_like(error, dtype=torch.bool))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the three terms from ``state``, ``action`` and ``has_action``."""
        state, recorded = self._inputs(tensordict)
        span = self.network.span(state.shape[-2])
        frames = slice(span.start, span.stop)
        target, counts = self._targets(tensordict, state, recorded, span)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            lifted, latent = self.network.lift(state), self.network.infer(state, span)
            predicted = self.network.predict_next(lifted[..., frames, :], latent)
            dynamics = (predicted - lifted[..., span.start + 1 : span.stop + 1, :]).square().mean(-1)
            error = self._action_error(self.network.decode(latent), target)
            losses = {
                "loss_reconstruction": self._reconstruction(state, lifted),
                "loss_dynamics": self.dynamics_coeff * self._reduce(dynamics, recorded[..., frames]),
                "loss_action": self.action_coeff * self._reduce(error, counts),
            }
        return TensorDict(losses)
