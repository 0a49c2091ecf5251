# This source code is licensed under the MIT license found in the LICENSE file.
"""Recovery augmentations of windows: the observed frames are displaced, and the future returns to the recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.keys import ACTION, STATE
from torchrl_koap.tasks.action_rules import OPEN_ABOVE, OPENING

_DIFFERENCE = 1e-3  # rad, of the numerical Jacobian
_DAMPING = 1e-4  # m2 / rad2, added to the squared reach of the joints: bounds them where the arm is stretched out
_LEFT = 0.5  # share of the way that is left after each step of opening fingers
EMPTY = 0.05  # m; fingers nearer to each other than that hold nothing: the boxes of Stacking are 0.06 m wide


def _remaining(state: Tensor, history: int, decay: float, ahead: int = 0, under_way: bool = False) -> Tensor:
    """Share of a shift that is left in every frame of windows ``[*B, T, d]``, so many frames later, ``[T, 1]``."""
    frames = torch.arange(state.shape[-2], device=state.device) - (history - 1) + ahead
    return (decay ** (frames if under_way else frames.clamp_min(0)).to(state.dtype))[:, None]


class RecoveryAugmentation(TensorDictModuleBase):
    r"""Recovery augmentation: displaces the observed frames of a window, and its future returns to the recording.

    .. math::
        x'_{t-j} = x_{t-j} + \delta, \qquad x'_{t+i} = x_{t+i} + \rho^i \delta, \qquad
        \delta = 2 \sigma\, r\, n, \; r \sim U(0, 1), \; n \sim N(0, I)

    A planner trained on demonstrations alone has seen no state off their paths, where it drifts in closed loop. The
    augmentation shows it such states together with the way back.

    Frames that all move alike show the moment of a push, and the earlier velocity. With ``under_way`` the robot is on
    its way back already, as in the next steps of the loop: :math:`x'_{t-j} = x_{t-j} + \rho^{-j} \delta`. Choose it
    where motions are so smooth that velocity follows from position, so that the difference of the two betrays a shift.

    A redundant arm is displaced at the tool, and the joints follow by the least motion that does it,
    :math:`\delta = J(x_t)^+ \delta_{tool}`.

    Args:
        sigma (float or Tensor): typical size of the shift, in the units of the state, or of every column, ``[d]``; with
            ``tool`` that of the tool (m).

    Keyword Args:
        history (int): observed frames of the window. Defaults to ``2``.
        decay (float): ``rho``, how slowly it comes back. Defaults to ``0.7``.
        under_way (bool): observed frames come back too. Defaults to ``False``.
        columns (sequence of int, optional): state columns to shift, those of the robot. Default: all.
        tool (sequence of int, optional): state columns of the tool's position; the shift is drawn there, and the
            arm's joints, which are then ``columns``, follow.
        kinematics (callable, optional): the function from joints ``[*B, J]`` to the position of the tool ``[*B, 3]``,
            needed with ``tool``, such as :func:`~torchrl_koap.tasks.panda_kinematics.tool_position`.
        moved_by (sequence of int, optional): for every action column the state column that it moves: actions are given
            the way back too, ``a'_{t+i} = a_{t+i} + (rho^{i+1} - rho^i) delta``. Default: no action is touched.
        state_key, action_key (NestedKey): of the windows. Default: ``"state"``, ``"action"``.

    Windows of ``state`` ``[*B, T, d]`` are replaced, with ``moved_by`` also ``action`` ``[*B, T, act]``; NaN stays.

    Raises:
        ValueError: for a negative ``sigma``, a ``decay`` outside [0, 1) (0 excluded with ``under_way``), a ``tool``
            without joints or kinematics.

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
        sigma: float | Tensor,
        *,
        history: int = 2,
        decay: float = 0.7,
        under_way: bool = False,
        columns: Sequence[int] | None = None,
        tool: Sequence[int] | None = None,
        kinematics: Callable[[Tensor], Tensor] | None = None,
        moved_by: Sequence[int] | None = None,
        state_key: NestedKey = STATE,
        action_key: NestedKey = ACTION,
    ):
        super().__init__()
        if tool is not None and (columns is None or kinematics is None):
            raise ValueError(f"a tool follows joints: wanted columns and kinematics, got {columns} and {kinematics}")
        if bool(torch.as_tensor(sigma < 0).any()) or not 0 <= decay < 1 or (under_way and not decay):
            raise ValueError(f"sigma must be >= 0 and decay in [0, 1), 0 without under_way, got {sigma} and {decay}")
        self.in_keys = self.out_keys = [state_key] if moved_by is None else [state_key, action_key]
        self.moved_by = None if moved_by is None else list(moved_by)
        self.sigma, self.history, self.decay, self.under_way = sigma, history, decay, under_way
        self.columns = None if columns is None else list(columns)
        self.tool = None if tool is None else list(tool)
        self.kinematics = kinematics

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by shifted ones."""
        state = tensordict.get(self.in_keys[0])
        size = torch.rand(*state.shape[:-2], 1, 1, dtype=state.dtype, device=state.device)
        shift = torch.randn(*state.shape[:-2], 1, state.shape[-1], dtype=state.dtype, device=state.device)
        sigma = self.sigma.to(state) if isinstance(self.sigma, Tensor) else self.sigma
        shift = self._of_joints(2 * sigma * size * shift, state)
        if self.columns is not None:
            keep = torch.zeros_like(shift)
            keep[..., self.columns] = 1
            shift = shift * keep
        remaining = _remaining(state, self.history, self.decay, under_way=self.under_way)
        shifted = state + shift * remaining
        if self.moved_by is not None:
            following = _remaining(state, self.history, self.decay, ahead=1, under_way=self.under_way)
            back = shift[..., self.moved_by] * (following - remaining)
            tensordict.set(self.in_keys[1], tensordict.get(self.in_keys[1]) + back)
        if self.tool is not None:
            moved = self.kinematics(shifted[..., self.columns]) - self.kinematics(state[..., self.columns])
            shifted[..., self.tool] = shifted[..., self.tool] + moved
        return tensordict.set(self.out_keys[0], shifted)

    def _of_joints(self, shift: Tensor, state: Tensor) -> Tensor:
        """Shifts ``[*B, 1, d]`` whose joints move the tool, if there is one, by its own columns, with least motion."""
        if self.tool is None:
            return shift
        joints = state[..., self.history - 1, self.columns]
        aside = _DIFFERENCE * torch.eye(joints.shape[-1], dtype=joints.dtype, device=joints.device)
        ends = (self.kinematics(joints.unsqueeze(-2) + sign * aside) for sign in (1, -1))  # each [*B, J, 3]
        jacobian = torch.sub(*ends).mT / (2 * _DIFFERENCE)  # [*B, 3, J]
        damped = jacobian @ jacobian.mT + _DAMPING * torch.eye(3, dtype=joints.dtype, device=joints.device)
        follow = jacobian.mT @ torch.linalg.solve(damped, shift[..., 0, self.tool].unsqueeze(-1))
        return shift.index_copy(-1, torch.tensor(self.columns, device=shift.device), follow.mT)


class GripperRecovery(TensorDictModuleBase):
    r"""Gripper recovery augmentation: replaces open fingers by closed, empty ones, and a future in which they open.

    .. math::
        w'_{t-j} = w_0, \qquad w'_{t+i} = \min(w_{t+i},\; w_{open} - \rho^i (w_{open} - w_0)), \qquad
        w_0 \sim U(0, w_{empty})

    Demonstrations in which every grasp succeeds never show fingers that are closed on nothing, so a planner leaves them
    closed after a grasp that misses. Windows are left alone in which the fingers hold something, or close within the
    steps that they need to open.

    Args:
        column (int): state column of the width between the fingers (m).

    Keyword Args:
        share (float): share of the windows it is done to, if their fingers are open, in [0, 1].
        history (int): observed frames of the window.
        state_key (NestedKey): of the windows. Default: ``"state"``.
    """

    def __init__(self, column: int, *, share: float = 0.1, history: int = 2, state_key: NestedKey = STATE):
        super().__init__()
        if not 0 <= share <= 1:
            raise ValueError(f"share must be in [0, 1], got {share}")
        self.in_keys = self.out_keys = [state_key]
        self.column, self.share, self.history = column, share, history

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by ones of which some show fingers that open."""
        state = tensordict.get(self.in_keys[0])
        width = state[..., self.column]
        kind = {"dtype": width.dtype, "device": width.device}
        chosen, begin = torch.rand(2, *width.shape[:-1], 1, **kind)
        looked_at = width[..., : self.history + OPENING]
        chosen = (chosen < self.share) & (looked_at > OPEN_ABOVE).all(-1, keepdim=True)
        ahead = (torch.arange(width.shape[-1], **kind) - (self.history - 1)).clamp_min(0)
        widest = width[..., self.history - 1 : self.history]
        opening = widest - _LEFT**ahead * (widest - EMPTY * begin)
        state = state.clone()
        state[..., self.column] = torch.where(chosen, torch.minimum(width, opening), width)
        return tensordict.set(self.out_keys[0], state)


class NeighborRecovery(TensorDictModuleBase):
    r"""Recovery augmentation along recorded differences: moves observed frames towards a neighbour's, and back.

    .. math::
        x'_{t-j} = x_{t-j} + \delta, \qquad x'_{t+i} = x_{t+i} + \rho^i \delta, \qquad
        \delta = s\, r\, (y_t - x_t), \; r \sim U(0, 1)

    with the present frame :math:`y_t` of the window of the batch that is nearest to it there. It is for embeddings of
    pictures, of which no column is a position: the nearest other one mostly shows the robot a little beside where it
    is.

    Args:
        share (float): ``s``, farthest share of the way to the neighbour; 0 changes nothing.

    Keyword Args:
        history, decay, state_key: as of :class:`RecoveryAugmentation`; windows must be a batch of two or more.
    """

    def __init__(self, share: float, *, history: int = 2, decay: float = 0.85, state_key: NestedKey = STATE):
        super().__init__()
        if not 0 <= share < math.inf or not 0 <= decay < 1:
            raise ValueError(f"share must be >= 0 and decay in [0, 1), got {share} and {decay}")
        self.in_keys = self.out_keys = [state_key]
        self.share, self.history, self.decay = share, history, decay

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by displaced ones."""
        state = tensordict.get(self.in_keys[0])
        if state.ndim != 3 or len(state) < 2:
            raise ValueError(f"neighbours are looked for in a batch [B, T, d] of two or more, got {list(state.shape)}")
        present = state[:, self.history - 1]
        apart = torch.cdist(present, present)
        apart.fill_diagonal_(torch.inf)
        way = present[apart.argmin(-1)] - present
        way = self.share * torch.rand(len(state), 1, dtype=state.dtype, device=state.device) * way
        remaining = _remaining(state, self.history, self.decay)
        return tensordict.set(self.out_keys[0], state + way[:, None] * remaining)
