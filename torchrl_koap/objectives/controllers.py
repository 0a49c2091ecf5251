# This source code is licensed under the MIT license found in the LICENSE file.
"""Losses of the controllers that KOAP is measured against."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from torchrl.objectives.common import LossModule

from torchrl_koap.keys import ACTION, HAS_ACTION, STATE
from torchrl_koap.modules.controllers import SupervisedInverseDynamics


class InverseDynamicsLoss(LossModule):
    """Mean square error of supervised inverse dynamics on the labelled frames but the first and last, ``loss_action``.

    A batch without labels gives exactly 0; an unlabelled (NaN) action reaches neither value nor gradient.

    Args:
        network (SupervisedInverseDynamics): the model.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import SupervisedInverseDynamics
        >>> from torchrl_koap.objectives import InverseDynamicsLoss
        >>> loss = InverseDynamicsLoss(SupervisedInverseDynamics(2, 2, hidden_dim=8))
        >>> batch = TensorDict({"state": torch.randn(4, 16, 2), "action": torch.full((4, 16, 2), torch.nan),
        ...                     "has_action": torch.zeros(4, 16, 1, dtype=torch.bool)}, [4])
        >>> loss(batch)["loss_action"].item()
        0.0
    """

    @dataclass
    class _AcceptedKeys:
        """Keys read from the input.

        Attributes:
            state (NestedKey): window of raw states ``[*B, T, d]``.
            action (NestedKey): raw actions ``[*B, T, act]``, NaN where unlabelled.
            has_action (NestedKey): labelled frames, bool ``[*B, T, 1]``.
        """

        state: NestedKey = STATE
        action: NestedKey = ACTION
        has_action: NestedKey = HAS_ACTION

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    network: SupervisedInverseDynamics
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    out_keys = ["loss_action"]

    def __init__(self, network: SupervisedInverseDynamics):
        super().__init__()
        self.convert_to_functional(network, "network", create_target_params=False)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys read from the input, as renamed by ``set_keys``."""
        return [self.tensor_keys.state, self.tensor_keys.action, self.tensor_keys.has_action]

    @in_keys.setter
    def in_keys(self, values) -> None:
        raise RuntimeError("in_keys follow the keys of the loss: use set_keys")

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """There is no value estimator."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDict:
        """Computes the loss."""
        state, action, has_action = (tensordict.get(key) for key in self.in_keys)
        labelled = has_action[..., 1:-1, :]
        target = self.network.normalize_action(torch.where(labelled, action[..., 1:-1, :], 0.0))
        with self.network_params.to_module(self.network, preserve_module_state=False):
            error = (self.network.predict(state)[..., 1:, :] - target).square()
        loss = torch.where(labelled, error, 0.0).sum() / (labelled.sum() * error.shape[-1]).clamp_min(1)
        return TensorDict({"loss_action": loss})
