# This source code is licensed under the MIT license found in the LICENSE file.
"""Augments windows by symmetries of the scene: its pose on the table, and the order of identical objects."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_koap.keys import ACTION, STATE


class RandomPlanarTransform(TensorDictModuleBase):
    """Random planar transform: shifts the whole scene, tool and objects together, and turns it about a vertical axis.

    How a tool pushes an object does not depend on the place on the table.

    Args:
        points (sequence): state columns ``(x, y)`` of every position.
        directions (sequence): state columns ``(cos, sin)`` of every yaw.

    Keyword Args:
        shift (float): standard deviation of the displacement (m). Defaults to ``0.05``.
        turn (float): standard deviation of the angle (rad). The centre is the first point in the last observed frame.
            Defaults to ``0.3``.
        turned_actions (sequence of int, optional): action columns ``(x, y)`` of a displacement, turned with the scene.
        history (int): observed frames of the window. Defaults to ``2``.
        state_key, action_key (NestedKey): keys in the windows. Default: ``"state"``, ``"action"``.

    Raises:
        ValueError: if ``shift`` or ``turn`` is negative.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import RandomPlanarTransform
        >>> window = torch.rand(8, 16, 4)
        >>> td = RandomPlanarTransform([(0, 1), (2, 3)], [], shift=0.1, turn=0.5)(TensorDict({"state": window}, [8]))
        >>> distance = lambda state: (state[..., :2] - state[..., 2:]).norm(dim=-1)
        >>> torch.allclose(distance(td["state"]), distance(window), atol=1e-5)
        True
    """

    def __init__(
        self,
        points: Sequence[tuple[int, int]],
        directions: Sequence[tuple[int, int]],
        *,
        shift: float = 0.05,
        turn: float = 0.3,
        history: int = 2,
        turned_actions: Sequence[int] | None = None,
        state_key: NestedKey = STATE,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        if shift < 0 or turn < 0:
            raise ValueError(f"shift and turn must be >= 0, got {shift} and {turn}")
        self.in_keys = self.out_keys = [state_key] if turned_actions is None else [state_key, action_key]
        self.turned_actions = None if turned_actions is None else list(turned_actions)
        self.points, self.directions = [list(pair) for pair in points], [list(pair) for pair in directions]
        self.shift, self.turn, self.history = shift, turn, history

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by transformed ones."""
        state = tensordict.get(self.in_keys[0])
        kind = {"dtype": state.dtype, "device": state.device}
        angle = self.turn * torch.randn(state.shape[:-2], **kind)
        cosine, sine = angle.cos(), angle.sin()
        turn = torch.stack([torch.stack([cosine, sine], -1), torch.stack([-sine, cosine], -1)], -2)  # for row vectors
        centre = state[..., self.history - 1 : self.history, self.points[0]]
        shift = self.shift * torch.randn(*state.shape[:-2], 1, 2, **kind)
        moved = state.clone()
        for pair in self.points:
            moved[..., pair] = (state[..., pair] - centre) @ turn + centre + shift
        for pair in self.directions:
            moved[..., pair] = state[..., pair] @ turn
        if self.turned_actions is not None:
            action = tensordict.get(self.in_keys[1]).clone()
            action[..., self.turned_actions] = action[..., self.turned_actions] @ turn
            tensordict.set(self.in_keys[1], action)
        return tensordict.set(self.out_keys[0], moved)


class ObjectPermutation(TensorDictModuleBase):
    """Random permutation of interchangeable objects, such as two red boxes.

    Args:
        groups (sequence): for each kind of object, the state columns of each instance (equally many per instance).

    Keyword Args:
        state_key (NestedKey): key in the windows. Default: ``"state"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import ObjectPermutation
        >>> windows = TensorDict({"state": torch.arange(4.0).expand(99, 5, 4)}, [99])
        >>> td = ObjectPermutation([[(0, 1), (2, 3)]])(windows)
        >>> sorted(set(td["state"][:, 0, 0].tolist()))
        [0.0, 2.0]
    """

    def __init__(self, groups: Sequence[Sequence[Sequence[int]]], *, state_key: NestedKey = STATE):
        super().__init__()
        self.in_keys = self.out_keys = [state_key]
        self.groups = [[list(columns) for columns in group] for group in groups]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by ones with permuted columns."""
        state = tensordict.get(self.in_keys[0])
        index = torch.arange(state.shape[-1], device=state.device).expand(*state.shape[:-2], -1).clone()
        for group in self.groups:
            columns = torch.tensor(group, device=state.device)  # [instances, columns]
            order = torch.rand(*state.shape[:-2], len(group), device=state.device).argsort(-1)
            index[..., columns.flatten()] = columns[order].flatten(-2)
        return tensordict.set(self.out_keys[0], state.gather(-1, index.unsqueeze(-2).expand_as(state)))
