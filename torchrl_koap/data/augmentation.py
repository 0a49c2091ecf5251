# This source code is licensed under the MIT license found in the LICENSE file.
"""Augmentations of windows: recovery from displacements, planar transforms, object permutations, continued ends."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.data.trajectories import trajectory_lengths
from torchrl_koap.keys import ACTION, EPISODE, STATE

_DIFFERENCE = 1e-3  # rad, of the numerical Jacobian
_DAMPING = 1e-4  # m2 / rad2, added to the squared reach of the joints: bounds them where the arm is stretched out


class RecoveryAugmentation(TensorDictModuleBase):
    r"""Recovery augmentation: moves the observed frames of a window aside and lets the future come back.

    .. math::
        x'_{t-j} = x_{t-j} + \delta, \qquad x'_{t+i} = x_{t+i} + \rho^i \delta, \qquad
        \delta = 2 \sigma\, r\, n, \; r \sim U(0, 1), \; n \sim N(0, I)

    A planner trained on demonstrations alone has never seen a state beside them; executed in closed loop it drifts
    there. The augmentation shows it such states together with the way back.

    An arm with more joints than its tool needs is moved aside at the tool: the tool is displaced, and the joints follow
    by the least motion that does it, :math:`\delta = J(x_t)^+ \delta_{tool}`. Joints shifted one by one would mostly
    turn the elbow about, and a planner that has seen that learns to wander.

    Args:
        sigma (float): typical size of the shift, in the units of the state; with ``tool`` that of the tool (m).

    Keyword Args:
        history (int): observed frames of the window. Defaults to ``2``.
        decay (float): ``rho``, how slowly it comes back. Defaults to ``0.7``.
        columns (sequence of int, optional): state columns to shift, those of the robot. Default: all.
        tool (sequence of int, optional): state columns of the tool's position; the shift is drawn there, and the
            arm's joints, which are then ``columns``, follow.
        kinematics (callable, optional): the function from joints ``[*B, J]`` to the position of the tool ``[*B, 3]``,
            needed with ``tool``, such as :func:`~torchrl_koap.tasks.panda_kinematics.tool_position`.
        moved_by (sequence of int, optional): for every action column the state column that it moves: actions are given
            the way back too, ``a'_{t+i} = a_{t+i} + (rho^{i+1} - rho^i) delta``. Default: no action is touched.
        key (NestedKey): window of states ``[*B, T, d]``, replaced. Defaults to ``"state"``.
        action_key (NestedKey): actions ``[*B, T, act]``, replaced with ``moved_by``; NaN stays. Defaults to
            ``"action"``.

    Raises:
        ValueError: for a negative ``sigma``, a ``decay`` outside [0, 1), a ``tool`` without joints or kinematics.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import RecoveryAugmentation
        >>> td = RecoveryAugmentation(0.004)(TensorDict({"state": torch.zeros(8, 16, 2)}, [8]))
        >>> torch.allclose(td["state"][:, 2], 0.7 * td["state"][:, 1])
        True
    """

    def __init__(
        self,
        sigma: float,
        *,
        history: int = 2,
        decay: float = 0.7,
        columns: Sequence[int] | None = None,
        tool: Sequence[int] | None = None,
        kinematics: Callable[[Tensor], Tensor] | None = None,
        moved_by: Sequence[int] | None = None,
        key: NestedKey = STATE,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        if tool is not None and (columns is None or kinematics is None):
            raise ValueError(f"a tool follows joints: wanted columns and kinematics, got {columns} and {kinematics}")
        if sigma < 0 or not 0 <= decay < 1:
            raise ValueError(f"sigma must be >= 0 and decay in [0, 1), got {sigma} and {decay}")
        self.in_keys = self.out_keys = [key] if moved_by is None else [key, action_key]
        self.moved_by = None if moved_by is None else list(moved_by)
        self.sigma, self.history, self.decay = sigma, history, decay
        self.columns = None if columns is None else list(columns)
        self.tool = None if tool is None else list(tool)
        self.kinematics = kinematics

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by shifted ones."""
        state = tensordict.get(self.in_keys[0])
        size = torch.rand(*state.shape[:-2], 1, 1, dtype=state.dtype, device=state.device)
        shift = torch.randn(*state.shape[:-2], 1, state.shape[-1], dtype=state.dtype, device=state.device)
        shift = 2 * self.sigma * size * self._of_joints(shift, state)
        if self.columns is not None:
            keep = torch.zeros_like(shift)
            keep[..., self.columns] = 1
            shift = shift * keep
        frames = torch.arange(state.shape[-2], device=state.device) - (self.history - 1)
        remaining = self.decay ** frames.clamp_min(0).to(state.dtype)
        shifted = state + shift * remaining[:, None]
        if self.moved_by is not None:
            following = self.decay ** (frames + 1).clamp_min(0).to(state.dtype)
            back = shift[..., self.moved_by] * (following - remaining)[:, None]
            tensordict.set(self.in_keys[1], tensordict.get(self.in_keys[1]) + back)
        if self.tool is not None and self.sigma:
            moved = self.kinematics(shifted[..., self.columns]) - self.kinematics(state[..., self.columns])
            shifted[..., self.tool] = shifted[..., self.tool] + moved
        return tensordict.set(self.in_keys[0], shifted)

    def _of_joints(self, shift: Tensor, state: Tensor) -> Tensor:
        """Shifts ``[*B, 1, d]`` whose joints move the tool, if there is one, by its own columns, with least motion."""
        if self.tool is None or not self.sigma:
            return shift
        joints = state[..., self.history - 1, self.columns]
        aside = _DIFFERENCE * torch.eye(joints.shape[-1], dtype=joints.dtype, device=joints.device)
        ends = (self.kinematics(joints.unsqueeze(-2) + sign * aside) for sign in (1, -1))  # each [*B, J, 3]
        jacobian = torch.sub(*ends).mT / (2 * _DIFFERENCE)  # [*B, 3, J]
        damped = jacobian @ jacobian.mT + _DAMPING * torch.eye(3, dtype=joints.dtype, device=joints.device)
        follow = jacobian.mT @ torch.linalg.solve(damped, shift[..., 0, self.tool].unsqueeze(-1))
        return shift.index_copy(-1, torch.tensor(self.columns, device=shift.device), follow.mT)


class RandomPlanarTransform(TensorDictModuleBase):
    """Random planar transform: moves and turns the whole scene, tool and objects together, about a vertical axis.

    How a tool pushes an object does not depend on where on the table that happens. A planner trained on few hundred
    demonstrations does not find that out by itself.

    Args:
        points (sequence): state columns ``(x, y)`` of every position.
        directions (sequence): state columns ``(cos, sin)`` of every yaw.

    Keyword Args:
        shift (float): standard deviation of the displacement (m). Defaults to ``0.05``.
        turn (float): standard deviation of the angle (rad); the scene turns about the first point of the last frame
            observed. Defaults to ``0.3``.
        history (int): observed frames of the window. Defaults to ``2``.
        turned_actions (sequence of int, optional): action columns ``(x, y)`` of a displacement, turned with the scene.
        key (NestedKey): window of states ``[*B, T, d]``, replaced. Defaults to ``"state"``.
        action_key (NestedKey): actions ``[*B, T, act]``, replaced with ``turned_actions``; NaN stays. Defaults to
            ``"action"``.

    Raises:
        ValueError: for a negative shift or turn.

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
        key: NestedKey = STATE,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        if shift < 0 or turn < 0:
            raise ValueError(f"shift and turn must be >= 0, got {shift} and {turn}")
        self.in_keys = self.out_keys = [key] if turned_actions is None else [key, action_key]
        self.turned_actions = None if turned_actions is None else list(turned_actions)
        self.points, self.directions = [list(pair) for pair in points], [list(pair) for pair in directions]
        self.shift, self.turn, self.history = shift, turn, history

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by moved ones."""
        state = tensordict.get(self.in_keys[0])
        kind = {"dtype": state.dtype, "device": state.device}
        angle = self.turn * torch.randn(state.shape[:-2], **kind)
        cosine, sine = angle.cos(), angle.sin()
        turn = torch.stack([torch.stack([cosine, sine], -1), torch.stack([-sine, cosine], -1)], -2)  # rows are turned
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
        return tensordict.set(self.in_keys[0], moved)


class ObjectPermutation(TensorDictModuleBase):
    """Random permutation of interchangeable objects: which of two red boxes is called the first does not matter.

    Args:
        groups (sequence): for each kind of object the state columns of each of its instances, all of the same number.
        key (NestedKey): window of states ``[*B, T, d]``, replaced. Defaults to ``"state"``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import ObjectPermutation
        >>> windows = TensorDict({"state": torch.arange(4.0).expand(99, 5, 4)}, [99])
        >>> td = ObjectPermutation([[(0, 1), (2, 3)]])(windows)
        >>> sorted(set(td["state"][:, 0, 0].tolist()))
        [0.0, 2.0]
    """

    def __init__(self, groups: Sequence[Sequence[Sequence[int]]], *, key: NestedKey = STATE):
        super().__init__()
        self.in_keys, self.out_keys = [key], [key]
        self.groups = [[list(columns) for columns in group] for group in groups]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by ones with exchanged columns."""
        state = tensordict.get(self.in_keys[0])
        index = torch.arange(state.shape[-1], device=state.device).expand(*state.shape[:-2], -1).clone()
        for group in self.groups:
            columns = torch.tensor(group, device=state.device)  # [instances, columns]
            order = torch.rand(*state.shape[:-2], len(group), device=state.device).argsort(-1)
            index[..., columns.flatten()] = columns[order].flatten(-2)
        return tensordict.set(self.in_keys[0], state.gather(-1, index.unsqueeze(-2).expand_as(state)))


def extrapolate_ends(data: TensorDictBase, frames: int, *, key: NestedKey = STATE, over: int = 3) -> TensorDict:
    """Continues every trajectory at its last mean velocity, so that a plan made near the end has a future.

    Args:
        data (TensorDictBase): flat data ``[N]`` with states ``[N, d]`` and ``episode``.
        frames (int): frames to append to each trajectory.

    Keyword Args:
        key (NestedKey): states. Defaults to ``"state"``.
        over (int): steps whose mean is the velocity. Defaults to ``3``.

    Returns:
        TensorDict: ``key`` and ``episode``, flat ``[N + trajectories * frames]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import extrapolate_ends
        >>> line = TensorDict({"state": torch.arange(5.0)[:, None], "episode": torch.zeros(5, dtype=torch.int64)}, [5])
        >>> extrapolate_ends(line, 2)["state"].flatten().tolist()
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    """
    lengths = trajectory_lengths(data).tolist()
    states, episodes = [], []
    for state, episode in zip(data.get(key).split(lengths), data.get(EPISODE).split(lengths), strict=True):
        steps = min(over, len(state) - 1)
        velocity = (state[-1] - state[-1 - steps]) / max(steps, 1)
        ahead = torch.arange(1, frames + 1, dtype=state.dtype, device=state.device)[:, None]
        states.append(torch.cat([state, state[-1] + ahead * velocity]))
        episodes.append(episode[:1].expand(len(state) + frames))
    states = torch.cat(states)
    return TensorDict({key: states, EPISODE: torch.cat(episodes)}, batch_size=[len(states)])
