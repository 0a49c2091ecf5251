# This source code is licensed under the MIT license found in the LICENSE file.
"""The loss of latent action policies (LAPO) with a quantised latent."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import dispatch

from torchrl_koap.modules.baselines.quantized import QuantizedInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class QuantizedDynamicsLoss(WindowLoss):
    r"""Computes the error of the next step, predicted from the past and the code of the transition, ``loss_dynamics``.

    .. math::
        L = \overline{|h_\psi(x_{t-n}, \dots, x_t, u_t) - (x_{t+1} - x_t)|^2}

    No label is read: actions are decoded by :class:`~torchrl_koap.objectives.ActionLoss`, afterwards. Args as for
    :class:`~torchrl_koap.objectives.base.WindowLoss`.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import QuantizedInverseDynamics
        >>> from torchrl_koap.objectives import QuantizedDynamicsLoss
        >>> loss = QuantizedDynamicsLoss(QuantizedInverseDynamics(2, 2))
        >>> loss(TensorDict({"state": torch.randn(4, 16, 2)}, [4]))["loss_dynamics"].shape
        torch.Size([])
    """

    network: QuantizedInverseDynamics
    out_keys = ["loss_dynamics"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss from ``state``."""
        state, recorded = self._inputs(tensordict)
        span = self.network.valid_frames(state.shape[-2])
        with self.network_params.to_module(self.network, preserve_module_state=False):
            predicted, step = self.network.predict_step(state, span)
            error = (predicted - step).square().mean(-1)
        return TensorDict({"loss_dynamics": self._reduce(error, recorded[..., span.start : span.stop])})
