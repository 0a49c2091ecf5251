# This source code is licensed under the MIT license found in the LICENSE file.
"""Losses of the controllers that KOAP is measured against."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictParams, dispatch
from torch import Tensor
from torchrl.objectives.common import LossModule

from torchrl_koap.keys import ACTION, HAS_ACTION, STATE
from torchrl_koap.modules.controllers import SupervisedInverseDynamics


class InverseDynamicsLoss(LossModule):
    """Mean square error of supervised inverse dynamics on the labelled frames but the first and last, ``loss_action``.

    A batch without labels gives exactly 0; an unlabelled (NaN) action reaches neither value nor gradient.

    Args:
        network (SupervisedInverseDynamics): the model.

    Keyword Args:
        reduction (str): ``"mean"`` (default), ``"sum"`` or ``"none"`` (``[*B, T - 2]``, 0 where masked).

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
            padded (NestedKey): optional; frames that repeat an edge of the trajectory, bool ``[*B, T, 1]``. A
                transition into or out of one does not count, labelled or not.
        """

        state: NestedKey = STATE
        action: NestedKey = ACTION
        has_action: NestedKey = HAS_ACTION
        padded: NestedKey = "padded"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    network: SupervisedInverseDynamics
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    out_keys = ["loss_action"]

    def __init__(self, network: SupervisedInverseDynamics, *, reduction: str = "mean"):
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        super().__init__()
        self.convert_to_functional(network, "network", create_target_params=False)
        self.reduction = reduction
        super().set_keys(state=network.in_keys[0], action=network.out_keys[0])

    def set_keys(self, **kwargs) -> None:
        """Renames entries (None: back to the default); ``state`` and ``action`` are renamed in the network too."""
        super().set_keys(**kwargs)
        self.network.set_keys(
            **{name: getattr(self.tensor_keys, name) for name in ("state", "action") if name in kwargs}
        )

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
        state, action = (self._read(tensordict, key) for key in self.in_keys[:2])
        counts = self._read_mask(tensordict, self.tensor_keys.has_action, state)[..., 1:-1, :]
        if tensordict.get(self.tensor_keys.padded, None) is not None:
            padded = self._read_mask(tensordict, self.tensor_keys.padded, state)
            counts = counts & ~(padded[..., 1:-1, :] | padded[..., 2:, :])
        # zeroed before the residual: masking afterwards would leave NaN in the gradient
        target = self.network.normalize_action(torch.where(counts, action[..., 1:-1, :], 0.0))
        with self.network_params.to_module(self.network, preserve_module_state=False):
            error = (self.network.predict(state)[..., 1:, :] - target).square().mean(-1, keepdim=True)
        error = torch.where(counts, error, 0.0)
        if self.reduction == "none":
            return TensorDict({"loss_action": error.squeeze(-1)})
        loss = error.sum()
        return TensorDict({"loss_action": loss if self.reduction == "sum" else loss / counts.sum().clamp_min(1)})

    @staticmethod
    def _read(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(f"the loss needs the entry {key!r}; there are {sorted(map(str, tensordict.keys(True)))}")
        return value

    def _read_mask(self, tensordict: TensorDictBase, key: NestedKey, state: Tensor) -> Tensor:
        """A mask of frames as bool ``[*B, T, 1]``."""
        mask = self._read(tensordict, key)
        mask = mask.unsqueeze(-1) if mask.shape == state.shape[:-1] else mask
        if mask.shape != (*state.shape[:-1], 1) or mask.dtype != torch.bool:
            raise ValueError(f"{key!r} must be bool {[*state.shape[:-1], 1]}, got {mask.dtype} {list(mask.shape)}")
        return mask
