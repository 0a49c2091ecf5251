# This source code is licensed under the MIT license found in the LICENSE file.
"""Recovery augmentations: they displace the observed frames of a window; its future returns to the recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torchrl_koap.keys import ACTION, STATE
from torchrl_koap.tasks.action_rules import OPEN_ABOVE, OPENING

_DIFFERENCE = 1e-3  # rad, half step of the central differences in the Jacobian
_DAMPING = 1e-4  # m2 / rad2, of the damped least squares: bounds the joint shifts where the arm is stretched out
DECAY = 0.7  # rho, share of a shift left after each frame, or after 1/30 s at higher rates
_NEIGHBOR_DECAY = 0.85  # rho towards a neighbour: share of the shift left after each frame
_WIDTH_DECAY = 0.5  # factor per step of the width that opening fingers still lack
EMPTY = 0.05  # m; fingers closer than this hold nothing: the boxes of Stacking are 0.06 m wide


def _remaining(state: Tensor, history: int, decay: float, ahead: int = 0, under_way: bool = False) -> Tensor:
    """Returns the share ``[T, 1]`` of a shift that is left ``ahead`` frames after each frame of ``[*B, T, d]``."""
    frames = torch.arange(state.shape[-2], device=state.device) - (history - 1) + ahead
    return (decay ** (frames if under_way else frames.clamp_min(0)).to(state.dtype))[:, None]


class RecoveryAugmentation(TensorDictModuleBase):
    r"""Recovery augmentation: displaces the observed frames of a window and lets its future return to the recording.

    .. math::
        x'_{t-j} = x_{t-j} + \delta, \qquad x'_{t+i} = x_{t+i} + \rho^i \delta, \qquad
        \delta = 2 \sigma\, r\, n, \; r \sim U(0, 1), \; n \sim N(0, I)

    A planner trained on demonstrations alone never sees states off their paths, so it drifts in closed loop. This
    augmentation adds such states and the way back.

    The observed frames all shift equally, as just after a push; their velocity stays as recorded. With ``under_way``
    the robot is already returning, as in later control steps: :math:`x'_{t-j} = x_{t-j} + \rho^{-j} \delta`. Choose
    this for smooth motions: where position determines velocity, a velocity that does not fit reveals the shift.

    For a redundant arm, shifts are drawn for tool and joints. The joints take the shift nearest to theirs that moves
    the tool by its own, :math:`\delta = \epsilon + J(x_t)^+ (\delta_{tool} - J(x_t) \epsilon)`; it turns the tool and
    the elbow. Without it, planners tend to continue the turn that the arm has begun.

    Args:
        sigma (float or Tensor): typical size of the shift in the units of the state, for all columns or for each,
            ``[d]``.

    Keyword Args:
        history (int): observed frames of the window. Defaults to ``2``.
        decay (float): ``rho``, share of the shift left after each frame. Defaults to ``0.7``.
        under_way (bool): observed frames return too. Defaults to ``False``.
        columns (sequence of int, optional): state columns to shift, those of the robot. Default: all.
        tool (sequence of int, optional): state columns of the tool's position. The shift is drawn there; ``columns``
            are then the arm's joints, which follow.
        kinematics (callable, optional): maps joints ``[*B, J]`` to the position of the tool ``[*B, 3]``; required
            with ``tool``. Example: :func:`~torchrl_koap.tasks.panda_kinematics.tool_position`.
        moved_by (sequence of int, optional): the state column that each action column moves. Actions then return
            too, ``a'_{t+i} = a_{t+i} + (rho^{i+1} - rho^i) delta``. Default: actions do not change.
        state_key, action_key (NestedKey): keys in the windows. Default: ``"state"``, ``"action"``.

    Replaces ``state`` ``[*B, T, d]``, and with ``moved_by`` also ``action`` ``[*B, T, act]``; NaN stays NaN.

    Raises:
        ValueError: if ``sigma`` is negative, ``decay`` is outside [0, 1) (or 0 with ``under_way``), or ``tool`` is
            given without ``columns`` or ``kinematics``.

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
        decay: float = DECAY,
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
            raise ValueError(f"tool: wanted columns and kinematics, got {columns} and {kinematics}")
        if bool(torch.as_tensor(sigma < 0).any()) or not 0 <= decay < 1 or (under_way and not decay):
            raise ValueError(f"sigma must be >= 0 and decay in [0, 1), not 0 with under_way, got {sigma} and {decay}")
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
        """Corrects the joint columns of shifts ``[*B, 1, d]`` so that they move the tool by its columns."""
        if self.tool is None:
            return shift
        joints = state[..., self.history - 1, self.columns]
        steps = _DIFFERENCE * torch.eye(joints.shape[-1], dtype=joints.dtype, device=joints.device)
        ends = (self.kinematics(joints.unsqueeze(-2) + sign * steps) for sign in (1, -1))  # each [*B, J, 3]
        jacobian = torch.sub(*ends).mT / (2 * _DIFFERENCE)  # [*B, 3, J]
        damped = jacobian @ jacobian.mT + _DAMPING * torch.eye(3, dtype=joints.dtype, device=joints.device)
        drawn = shift[..., 0, self.columns].unsqueeze(-1)
        missing = shift[..., 0, self.tool].unsqueeze(-1) - jacobian @ drawn
        follow = drawn + jacobian.mT @ torch.linalg.solve(damped, missing)
        return shift.index_copy(-1, torch.tensor(self.columns, device=shift.device), follow.mT)


class GripperRecovery(TensorDictModuleBase):
    r"""Gripper recovery augmentation: replaces open fingers by closed, empty ones that open in the planned frames.

    .. math::
        w'_{t-j} = w_0, \qquad w'_{t+i} = \min(w_{t+i},\; w_{open} - \rho^i (w_{open} - w_0)), \qquad
        w_0 \sim U(0, w_{empty})

    If every demonstrated grasp succeeds, the planner never sees empty closed fingers and leaves them closed after a
    missed grasp. Windows stay as they are where the fingers hold something, or close within the steps that opening
    takes.

    Args:
        column (int): state column of the width between the fingers (m).

    Keyword Args:
        share (float): share of the windows with open fingers to replace.
        history (int): observed frames of the window.
    """

    def __init__(self, column: int, *, share: float = 0.1, history: int = 2):
        super().__init__()
        self.in_keys = self.out_keys = [STATE]
        self.column, self.share, self.history = column, share, history

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the finger width in some of the windows."""
        state = tensordict.get(self.in_keys[0])
        width = state[..., self.column]
        kind = {"dtype": width.dtype, "device": width.device}
        chosen, begin = torch.rand(2, *width.shape[:-1], 1, **kind)
        checked = width[..., : self.history + OPENING]
        chosen = (chosen < self.share) & (checked > OPEN_ABOVE).all(-1, keepdim=True)
        ahead = (torch.arange(width.shape[-1], **kind) - (self.history - 1)).clamp_min(0)
        widest = width[..., self.history - 1 : self.history]
        opening = widest - _WIDTH_DECAY**ahead * (widest - EMPTY * begin)
        state = state.clone()
        state[..., self.column] = torch.where(chosen, torch.minimum(width, opening), width)
        return tensordict.set(self.out_keys[0], state)


class NeighborRecovery(TensorDictModuleBase):
    r"""Recovery augmentation along recorded differences: shifts observed frames towards a neighbour and back.

    .. math::
        x'_{t-j} = x_{t-j} + \delta, \qquad x'_{t+i} = x_{t+i} + \rho^i \delta, \qquad
        \delta = s\, r\, (y_t - x_t), \; r \sim U(0, 1)

    where :math:`y_t` is the nearest present frame among the other windows of the batch. Meant for image embeddings,
    which have no position columns: the nearest neighbour mostly shows the robot slightly displaced.

    Args:
        share (float): ``s``, largest share of the way to the neighbour; 0 changes nothing.

    Keyword Args:
        history (int): observed frames of the window. A batch needs two or more windows.
    """

    def __init__(self, share: float, *, history: int = 2):
        super().__init__()
        if not 0 <= share < math.inf:
            raise ValueError(f"share must be >= 0, got {share}")
        self.in_keys = self.out_keys = [STATE]
        self.share, self.history = share, history

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by shifted ones."""
        state = tensordict.get(self.in_keys[0])
        if state.ndim != 3 or len(state) < 2:
            raise ValueError(f"wanted a batch of states [B, T, d] with B >= 2, got {list(state.shape)}")
        present = state[:, self.history - 1]
        distance = torch.cdist(present, present)
        distance.fill_diagonal_(torch.inf)
        shift = present[distance.argmin(-1)] - present
        shift = self.share * torch.rand(len(state), 1, dtype=state.dtype, device=state.device) * shift
        remaining = _remaining(state, self.history, _NEIGHBOR_DECAY)
        return tensordict.set(self.out_keys[0], state + shift[:, None] * remaining)
