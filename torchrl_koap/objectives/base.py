# This source code is licensed under the MIT license found in the LICENSE file.
"""Base classes of the losses, with keys that can be renamed, masks and reductions."""

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

    A subclass has the dataclass ``_AcceptedKeys`` and lists its mandatory entries in :attr:`required`. With
    ``create_target_params``, ``target_network_params`` holds an averaged copy of the weights. Raises a ValueError if
    the reduction is not ``"mean"``, ``"sum"`` or ``"none"``, a TypeError if the network is of no type in ``trains``.
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
        """Sets the mode of the loss and of its network, which is not a submodule."""
        super().train(mode)
        self.network.train(mode)
        return self

    def _apply(self, fn):
        """Moves the network too: the loss holds its parameters, but not its buffers."""
        super()._apply(fn)
        self.network_params.to_module(self.network)
        return self

    def __setstate__(self, state):
        """Restores a copy or pickle; its network then uses the weights of the copy."""
        super().__setstate__(state)
        self.network_params.to_module(self.network)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Mandatory entries, as renamed by ``set_keys``."""
        return [getattr(self.tensor_keys, name) for name in self.required]

    def _read(self, tensordict: TensorDictBase, name: str) -> Tensor:
        return read_entry(self, tensordict, getattr(self.tensor_keys, name), f"set_keys({name}=...)")

    def _read_or_draw(
        self, tensordict: TensorDictBase, name: str, shape: torch.Size, draw: Callable[[], Tensor]
    ) -> Tensor:
        """Reads an optional entry, such as noise, or draws it if it is missing; raises for another shape."""
        key = getattr(self.tensor_keys, name)
        value = tensordict.get(key, None)
        value = draw() if value is None else value
        if value.shape != shape:
            raise ValueError(f"{key!r} must be {list(shape)}, got {list(value.shape)}")
        return value

    def _read_mask(self, tensordict: TensorDictBase, name: str, state: Tensor) -> Tensor:
        """Reads a mask ``[*B, T]``, or ``[*B, T, 1]``, of the frames of windows ``[*B, T, d]``."""
        return frame_mask(self._read(tensordict, name), repr(getattr(self.tensor_keys, name)), state)

    def _recorded(self, tensordict: TensorDictBase, state: Tensor) -> Tensor:
        """Returns which transitions are between two recorded (not padded) frames, bool ``[*B, T - 1]``."""
        recorded = torch.ones_like(state[..., 0], dtype=torch.bool)
        if tensordict.get(self.tensor_keys.padded, None) is not None:
            recorded = ~self._read_mask(tensordict, "padded", state)
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, None)
            recorded = recorded if mask is None else recorded & frame_mask(mask, repr(key), state)
        return recorded[..., 1:] & recorded[..., :-1]

    def _reduce(self, error: Tensor, mask: Tensor | None = None) -> Tensor:
        """Reduces errors. Those outside a mask (of the same shape, or with a trailing 1) become 0 and do not count."""
        if mask is None:
            return self._reduce_loss(error)
        error = torch.where(mask, error, 0.0)
        if self.reduction == "none":
            return error
        return error.sum() / (mask.expand_as(error).sum().clamp_min(1) if self.reduction == "mean" else 1)


class WindowLoss(NetworkLoss):
    """Base class of the losses on windows of states of which some frames have an action label.

    States and actions are read from the keys of the network, an InverseDynamics. Reductions are ``"mean"`` (default),
    ``"sum"`` and ``"none"`` (``[*B, frames]``, masked entries are 0).
    """

    @dataclass
    class _AcceptedKeys:
        """Keys read from the input.

        Attributes:
            state (NestedKey): window of raw states ``[*B, T, d]``.
            action (NestedKey): raw actions ``[*B, T, act]``, NaN where unlabelled.
            has_action (NestedKey): labelled frames, bool ``[*B, T, 1]``.
            padded (NestedKey): optional; frames that repeat an edge of the trajectory, bool ``[*B, T]``. Transitions
                to or from padded frames count in no loss, labelled or not. Frames that TorchRL's ``loss_mask_key``
                leaves out are padded too, such as those of ``SliceSampler(pad_output=True)``.

        Both masks may have a trailing 1. Reshape a flat batch ``[B * T]``, such as that of TorchRL's ``SliceSampler``,
        to ``[B, T]``: it would be read as one window. It raises a ValueError if ``episode`` or ``done`` shows several.
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
        """Renames entries (None: restores the default); ``state`` and ``action`` are renamed in the network too.

        If the network needs other names, call its ``set_keys`` afterwards.
        """
        super().set_keys(**kwargs)
        self.network.set_keys(
            **{name: getattr(self.tensor_keys, name) for name in ("state", "action") if name in kwargs}
        )

    def _inputs(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Reads the raw states, and which transitions are between two recorded frames, bool ``[*B, T - 1]``."""
        state = check_window(tensordict, self.tensor_keys.state, self._read(tensordict, "state"))
        return state, self._recorded(tensordict, state)

    def _targets(
        self, tensordict: TensorDictBase, state: Tensor, recorded: Tensor, span: range
    ) -> tuple[Tensor, Tensor]:
        """Reads normalised actions ``[*B, frames, act]`` of a span and which count; others are 0 before normalising."""
        frames = slice(span.start, span.stop)
        action = check_actions(self._read(tensordict, "action"), self.tensor_keys.action, state)[..., frames, :]
        counts = self._read_mask(tensordict, "has_action", state)[..., frames] & recorded[..., frames]
        # set to 0 before the residual: masking afterwards would leave NaN in the gradient
        action = torch.where(counts.unsqueeze(-1), action, 0.0)
        return self.network.normalize_action(action), counts

    def _action_error(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Computes the mean squared error ``[*B, frames]`` of actions; raises for different numbers of columns."""
        if predicted.shape[-1] != target.shape[-1]:  # a single column would be broadcast
            columns = f"{target.shape[-1]} columns, the network decodes {predicted.shape[-1]}"
            raise ValueError(f"{self.tensor_keys.action!r} has {columns}")
        return (predicted - target).square().mean(-1)
