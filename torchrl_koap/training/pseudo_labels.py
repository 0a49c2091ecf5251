# This source code is licensed under the MIT license found in the LICENSE file.
"""Relabelling: a controller's actions replace the labels that the budget hides."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase

from torchrl_koap.data.trajectories import extrapolate_ends
from torchrl_koap.data.windows import WindowTable
from torchrl_koap.keys import ACTION, HAS_ACTION, STATE
from torchrl_koap.modules import InverseDynamics

_BATCH = 4096  # windows per forward pass


@torch.no_grad()
def relabel(controller: InverseDynamics, data: TensorDictBase, *, window: int) -> TensorDictBase:
    """Gives every unlabelled step the action that a controller in evaluation mode infers from recorded states.

    The action is that of frame ``controller.num_past`` of a window. Beyond the ends of a trajectory, the first state
    is repeated and the last ones continue at their velocity (:func:`~torchrl_koap.data.extrapolate_ends`)::

        frame            0      1      2      ...    window - 1         (history = 1)
        action of step 0 x_0    x_0    x_1    ...
        action of step t x_t-1  x_t    x_t+1  ...

    Flat data ``[N]`` have ``state`` as the controller sees it, and are not changed. Returns a shallow copy in which
    every step has an action; labelled steps keep theirs bit for bit.
    """
    hidden, now = ~data[HAS_ACTION].squeeze(-1), controller.num_past
    action = data[ACTION].clone()
    continued = extrapolate_ends(data, window - 1 - now)
    # one window per hidden step, with the step at frame `now`, in the order of the data
    frames, _ = WindowTable.build(continued, window, counted=range(now, window - 1), pad_before=now).frames(hidden)
    rows = hidden.nonzero().squeeze(-1)
    for first in range(0, len(rows), _BATCH):
        part = slice(first, first + _BATCH)
        windows = TensorDict({controller.in_key: continued[STATE][frames[part]]}, frames[part].shape)
        action[rows[part]] = controller(windows)[controller.out_key][:, now]
    return data.copy().update({ACTION: action, HAS_ACTION: torch.ones_like(data[HAS_ACTION])})
