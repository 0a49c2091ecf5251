# This source code is licensed under the MIT license found in the LICENSE file.
"""Base classes of the losses: keys that can be renamed, masks, reduction."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictParams
from torch import Tensor, nn
from torchrl.objectives.common import LossModule

from torchrl_koap.keys import ACTION, HAS_ACTION, PADDED, STATE, check_actions, check_window, frame_mask, read_entry
from torchrl_koap.modules.inverse_dynamics import InverseDynamics


class NetworkLoss(LossModule):
    """Base class of all losses here: one network, keys that can be renamed, a reduction.

    A subclass has the dataclass ``_AcceptedKeys`` and names in :attr:`required` the entries that must be there. With
    ``create_target_params`` an averaged copy of the weights is kept in ``target_network_params``; the reduction is
    ``"mean"``, ``"sum"`` or ``"none"``. Another one, and a network of another kind than :attr:`trains`, are errors.
    """

    trains: tuple[type[nn.Module], ...] = (nn.Module,)
    network: nn.Module
    network_params: TensorDictParams
    target_network_params: TensorDictParams
    required: tuple[str, ...] = ("state",)

    def __init__(self, network: nn.Module, *, create_target_params: bool = False, reduction: str = "mean"):
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"reduction must be 'none', 'mean' or 'sum', got {reduction!r}")
        if not isinstance(network, self.trains):
            wanted, got = " or ".join(kind.__name__ for kind in self.trains), type(network).__name__
            inside = isinstance(network, nn.Module) and any(isinstance(part, self.trains) for part in network.modules())
            cure = "; pass the module inside it" if inside else ""
            raise TypeError(f"{type(self).__name__} trains a {wanted}, got {got}{cure}")
        super().__init__()
        self.convert_to_functional(network, "network", create_target_params=create_target_params)
        self.reduction = reduction

    def train(self, mode: bool = True):
        """Sets the mode of the loss, and of the network, which is no submodule of it."""
        super().train(mode)
        self.network.train(mode)
        return self

    def _apply(self, fn):
        """Moves the network too: its parameters are those of the loss, its buffers would stay behind."""
        super()._apply(fn)
        self.network_params.to_module(self.network)
        return self

    def __setstate__(self, state):
        """Gives the network of a copy the weights of the copy."""
        super().__setstate__(state)
        self.network_params.to_module(self.network)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that must be there, as renamed by ``set_keys``."""
        return [getattr(self.tensor_keys, name) for name in self.required]

    @in_keys.setter
    def in_keys(self, values) -> None:
        raise RuntimeError("in_keys follow the keys of the loss: use set_keys")

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        """There is no value estimator."""

    def _read(self, tensordict: TensorDictBase, name: str) -> Tensor:
        return read_entry(self, tensordict, getattr(self.tensor_keys, name), f"set_keys({name}=...)")

    def _read_or_draw(
        self, tensordict: TensorDictBase, name: str, shape: torch.Size, draw: Callable[[], Tensor]
    ) -> Tensor:
        """Reads an optional entry, such as noise, that must have a shape; draws it where it is not there."""
        key = getattr(self.tensor_keys, name)
        value = tensordict.get(key, None)
        value = draw() if value is None else value
        if value.shape != shape:
            raise ValueError(f"{key!r} must be {list(shape)}, got {list(value.shape)}")
        return value

    def _read_mask(self, tensordict: TensorDictBase, name: str, state: Tensor) -> Tensor:
        """Reads a mask ``[*B, T]`` of the frames of windows ``[*B, T, d]``, stored with a trailing 1 or not."""
        return frame_mask(self._read(tensordict, name), repr(getattr(self.tensor_keys, name)), state)

    def _recorded(self, tensordict: TensorDictBase, state: Tensor) -> Tensor:
        """Transitions between two recorded frames, bool ``[*B, T - 1]``."""
        if tensordict.get(self.tensor_keys.padded, None) is None:
            return torch.ones(state.shape[:-2] + (state.shape[-2] - 1,), dtype=torch.bool, device=state.device)
        padded = self._read_mask(tensordict, "padded", state)
        return ~(padded[..., 1:] | padded[..., :-1])

    def _reduce(self, error: Tensor, mask: Tensor | None = None) -> Tensor:
        """Reduces errors; those outside of a mask, of their shape or with a trailing 1, are 0 and do not count."""
        if mask is None:
            return self._reduce_loss(error)
        error = torch.where(mask, error, 0.0)
        if self.reduction == "none":
            return error
        return error.sum() / (mask.expand_as(error).sum().clamp_min(1) if self.reduction == "mean" else 1)


class WindowLoss(NetworkLoss):
    """Base class of the losses on windows of states of which some frames have an action label.

    States and actions are read where the network, an InverseDynamics, has them. Reductions are ``"mean"`` (default),
    ``"sum"`` and ``"none"`` (``[*B, frames]``, 0 where masked).
    """

    @dataclass
    class _AcceptedKeys:
        """Keys read from the input.

        Attributes:
            state (NestedKey): window of raw states ``[*B, T, d]``.
            action (NestedKey): raw actions ``[*B, T, act]``, NaN where unlabelled.
            has_action (NestedKey): labelled frames, bool ``[*B, T, 1]``.
            padded (NestedKey): optional; frames that repeat an edge of the trajectory, bool ``[*B, T]``. A transition
                into or out of one counts in no loss, labelled or not.

        The two masks may have a trailing 1 or not. A flat batch ``[B * T]``, as of TorchRL's ``SliceSampler``, must be
        reshaped to ``[B, T]``: it would be one window, and is refused where ``episode`` tells.
        """

        state: NestedKey = STATE
        action: NestedKey = ACTION
        has_action: NestedKey = HAS_ACTION
        padded: NestedKey = PADDED

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    trains: tuple[type[nn.Module], ...] = (InverseDynamics,)
    network: InverseDynamics

    def __init__(self, network: InverseDynamics, *, reduction: str = "mean"):
        super().__init__(network, reduction=reduction)
        super().set_keys(state=network.in_key, action=network.out_key)

    def set_keys(self, **kwargs) -> None:
        """Renames entries (None: back to the default); ``state`` and ``action`` are renamed in the network too.

        Call ``set_keys`` of the network afterwards if it needs other names.
        """
        super().set_keys(**kwargs)
        self.network.set_keys(
            **{name: getattr(self.tensor_keys, name) for name in ("state", "action") if name in kwargs}
        )

    def _inputs(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """The raw states and the transitions between two recorded frames ``[*B, T - 1]``."""
        state = self._read(tensordict, "state")
        check_window(tensordict, self.tensor_keys.state, state)
        return state, self._recorded(tensordict, state)

    def _targets(
        self, tensordict: TensorDictBase, state: Tensor, recorded: Tensor, span: range
    ) -> tuple[Tensor, Tensor]:
        """Normalised actions ``[*B, frames, act]`` of a span, 0 where they do not count; and where they do."""
        frames = slice(span.start, span.stop)
        action = check_actions(self._read(tensordict, "action"), self.tensor_keys.action, state)[..., frames, :]
        counts = self._read_mask(tensordict, "has_action", state)[..., frames] & recorded[..., frames]
        # zeroed before the residual: masking afterwards would leave NaN in the gradient
        action = torch.where(counts.unsqueeze(-1), action, 0.0)
        return self.network.normalize_action(action), counts

    def _action_error(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Mean squared error ``[*B, frames]`` of actions that must have as many columns as they are decoded to."""
        if predicted.shape[-1] != target.shape[-1]:  # a single column would be broadcast
            columns = f"{target.shape[-1]} columns, the network decodes {predicted.shape[-1]}"
            raise ValueError(f"{self.tensor_keys.action!r} has {columns}")
        return (predicted - target).square().mean(-1)
