# This source code is licensed under the MIT license found in the LICENSE file.
"""Gripper recovery: fingers that closed on nothing open again, in windows in which they were recorded open."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase

from torchrl_koap.keys import STATE

EMPTY = 0.05  # m; fingers nearer to each other than that hold nothing: the boxes of Stacking are 0.06 m wide


class GripperRecovery(TensorDictModuleBase):
    r"""Gripper recovery augmentation: shows open fingers as closed on nothing, and a future in which they open.

    .. math::
        w'_{t-j} = w_0, \qquad w'_{t+i} = \min(w_{t+i},\; w_{open} - \rho^i (w_{open} - w_0)), \qquad
        w_0 \sim U(0, w_{empty})

    Demonstrations in which every grasp succeeds never show fingers that are closed with nothing between them. A planner
    trained on them alone has no idea what comes next, plans that they stay as they are, and one grasp that misses ends
    the episode: the fingers never open again. Windows are left alone in which the fingers hold something, or close
    within the steps that they need to open.

    Args:
        column (int): state column of the width between the fingers (m).

    Keyword Args:
        share (float): share of the windows it is done to, if their fingers are open. Defaults to ``0.1``.
        empty (float): widest fingers that hold nothing (m). Defaults to ``0.05``.
        open_above (float): narrowest fingers that count as open (m). Defaults to ``0.075``.
        steps (int): control steps that opening takes. Defaults to ``5``.
        decay (float): ``rho``, share of the way that remains after a control step. Defaults to ``0.5``.
        history (int): observed frames of the window. Defaults to ``2``.
        key (NestedKey): window of states ``[*B, T, d]``, replaced. Defaults to ``"state"``.

    Raises:
        ValueError: for a share or decay outside [0, 1], or an empty hand as wide as an open one.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import GripperRecovery
        >>> _ = torch.manual_seed(0)
        >>> augment = GripperRecovery(0, share=1.0)
        >>> augment(TensorDict({"state": torch.full([1, 8, 1], 0.08)}, [1]))["state"][0, :, 0]
        tensor([0.0384, 0.0384, 0.0592, 0.0696, 0.0748, 0.0774, 0.0787, 0.0794])
        >>> augment(TensorDict({"state": torch.full([1, 4, 1], 0.06)}, [1]))["state"][0, :, 0]  # a box is held
        tensor([0.0600, 0.0600, 0.0600, 0.0600])
    """

    def __init__(
        self,
        column: int,
        *,
        share: float = 0.1,
        empty: float = EMPTY,
        open_above: float = 0.075,
        steps: int = 5,
        decay: float = 0.5,
        history: int = 2,
        key: NestedKey = STATE,
    ):
        super().__init__()
        if not 0 <= share <= 1 or not 0 <= decay <= 1:
            raise ValueError(f"share and decay must be in [0, 1], got {share} and {decay}")
        if not 0 < empty < open_above:
            raise ValueError(f"empty must be above 0 and below open_above, got {empty} and {open_above}")
        self.in_keys = self.out_keys = [key]
        self.column, self.share, self.history = column, share, history
        self.empty, self.open_above, self.steps, self.decay = empty, open_above, steps, decay

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces the windows by ones of which some show fingers that open."""
        state = tensordict.get(self.in_keys[0])
        width = state[..., self.column]
        kind = {"dtype": width.dtype, "device": width.device}
        chosen, begin = torch.rand(2, *width.shape[:-1], 1, **kind)
        looked_at = width[..., : self.history + self.steps]
        chosen = (chosen < self.share) & (looked_at > self.open_above).all(-1, keepdim=True)
        ahead = (torch.arange(width.shape[-1], **kind) - (self.history - 1)).clamp_min(0)
        widest = width[..., self.history - 1 : self.history]
        opening = widest - self.decay**ahead * (widest - self.empty * begin)
        state = state.clone()
        state[..., self.column] = torch.where(chosen, torch.minimum(width, opening), width)
        return tensordict.set(self.in_keys[0], state)
