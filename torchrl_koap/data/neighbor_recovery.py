# This source code is licensed under the MIT license found in the LICENSE file.
"""Recovery where no column is a position: what is beside a demonstration is what other demonstrations show."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey

from torchrl_koap.keys import STATE


class NeighborRecovery(TensorDictModuleBase):
    r"""Recovery augmentation along recorded differences: moves observed frames towards a neighbour's, and back.

    .. math::
        x'_{t-j} = x_{t-j} + \delta, \qquad x'_{t+i} = x_{t+i} + \rho^i \delta, \qquad
        \delta = s\, r\, (y_t - x_t), \; r \sim U(0, 1)

    with the present frame :math:`y_t` of the window of the batch that is nearest to it there.
    :class:`~torchrl_koap.data.RecoveryAugmentation` displaces the robot, which takes columns that are its position. In
    the embedding of a camera's picture none is, and a random vector is no picture; the difference of two pictures
    nearly is one, and the nearest other one mostly shows the robot a little beside where it is.

    Args:
        share (float): ``s``, farthest share of the way to the neighbour; 0 changes nothing.

    Keyword Args:
        history (int): observed frames of the window. Defaults to ``2``.
        decay (float): ``rho``, how slowly it comes back. Defaults to ``0.85``.
        key (NestedKey): window of states ``[B, T, d]``, replaced. Defaults to ``"state"``.

    Raises:
        ValueError: for a negative ``share`` or a ``decay`` outside [0, 1); at a call, for windows that are not a batch
            of two or more.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.data import NeighborRecovery
        >>> windows = torch.tensor([0.0, 1.0, 5.0]).reshape(3, 1, 1).expand(3, 4, 1)
        >>> moved = NeighborRecovery(1.0)(TensorDict({"state": windows}, [3]))["state"]
        >>> bool((moved[2, 0] >= 1).all()), bool((moved[2, 0] <= 5).all())  # the third one's neighbour is the second
        (True, True)
    """

    def __init__(self, share: float, *, history: int = 2, decay: float = 0.85, key: NestedKey = STATE):
        super().__init__()
        if not 0 <= share < math.inf or not 0 <= decay < 1:
            raise ValueError(f"share must be >= 0 and decay in [0, 1), got {share} and {decay}")
        self.in_keys = self.out_keys = [key]
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
        frames = torch.arange(state.shape[-2], device=state.device) - (self.history - 1)
        remaining = self.decay ** frames.clamp_min(0).to(state.dtype)
        return tensordict.set(self.in_keys[0], state + way[:, None] * remaining[:, None])
