# This source code is licensed under the MIT license found in the LICENSE file.
"""The loss of inverse dynamics networks that labels alone teach."""

from __future__ import annotations

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch

from torchrl_koap.modules.baselines.supervised import RecurrentInverseDynamics, SupervisedInverseDynamics
from torchrl_koap.objectives.base import WindowLoss


class InverseDynamicsLoss(WindowLoss):
    """Mean square error of supervised inverse dynamics on the labelled frames of its span, ``loss_action``.

    A batch without labels gives exactly 0; an unlabelled (NaN) action reaches neither value nor gradient.

    Args:
        network (SupervisedInverseDynamics or RecurrentInverseDynamics): the model.

    Keyword Args:
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, frames]``, 0 where masked).

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import SupervisedInverseDynamics
        >>> from torchrl_koap.objectives import InverseDynamicsLoss
        >>> loss = InverseDynamicsLoss(SupervisedInverseDynamics(2, 2))
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.full((4, 16, 2), torch.nan),
        ...                     "has_action": torch.zeros(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].item()
        0.0
    """

    network: SupervisedInverseDynamics | RecurrentInverseDynamics
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    out_keys = ["loss_action"]
    uses_labels = True

    def __init__(self, network: SupervisedInverseDynamics | RecurrentInverseDynamics, *, reduction: str = "mean"):
        super().__init__(network, reduction=reduction)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss."""
        state, recorded = self._inputs(tensordict)
        span = self.network.span(state.shape[-2])
        target, counts = self._targets(tensordict, state, recorded, span)
        with self.network_params.to_module(self.network, preserve_module_state=False):
            error = self._action_error(self.network.predict(state, span), target)
        return TensorDict({"loss_action": self._reduce(error, counts)})
