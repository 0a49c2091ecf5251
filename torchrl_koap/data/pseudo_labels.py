# This source code is licensed under the MIT license found in the LICENSE file.
"""Relabelling: a controller's actions in place of the labels that the budget hides."""

from __future__ import annotations

import itertools

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from torchrl_koap.data.trajectories import extrapolate_ends
from torchrl_koap.data.windows import WindowTable
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, STATE

RELABELLED = "relabelled"
_BATCH = 4096  # windows per forward pass


@torch.no_grad()
def relabel(controller: nn.Module, data: TensorDictBase, *, window: int) -> TensorDict:
    """Gives every unlabelled step the action that an inverse dynamics reads off the recorded states.

    An action is read at frame ``controller.num_past`` of a window. Over the ends of a trajectory the first state is
    repeated, and the last ones go on at their velocity (:func:`~torchrl_koap.data.extrapolate_ends`)::

        frame            0      1      2      ...    window - 1         (history = 1)
        action of step 0 x_0    x_0    x_1    ...
        action of step t x_t-1  x_t    x_t+1  ...

    Flat data ``[N]`` have ``state`` as the controller sees it, and are not changed. In the shallow copy that is
    returned every step has an action; labelled steps keep theirs bit for bit. The new entry ``relabelled`` ``[N, 1]``
    is True where the action is the controller's.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if the window is too short for the controller, or its actions are not finite or of another width.
    """
    for key in (STATE, ACTION, HAS_ACTION, EPISODE):
        if data.get(key, None) is None:
            raise KeyError(f"relabelling needs the entry {key!r}; there are {sorted(map(str, data.keys()))}")
    if window < controller.num_window_frames:
        raise ValueError(f"the controller needs windows of {controller.num_window_frames} frames, got {window}")
    hidden = ~data.get(HAS_ACTION).reshape(-1)
    action = data.get(ACTION).clone()
    if hidden.any():
        predicted = _predict(controller, data, hidden, window)
        if predicted.shape[-1] != action.shape[-1]:
            raise ValueError(
                f"the controller's actions have {predicted.shape[-1]} columns, those of the data {action.shape[-1]}"
            )
        bad = ~predicted.isfinite().all(-1)
        if bad.any():
            raise ValueError(f"the controller's actions are not finite in {int(bad.sum())} of {len(bad)} steps")
        action[hidden] = predicted.to(action)
    result = data.copy().set(ACTION, action).set(HAS_ACTION, torch.ones_like(data.get(HAS_ACTION)))
    return result.set(RELABELLED, hidden.reshape(data.get(HAS_ACTION).shape))


def _predict(controller: nn.Module, data: TensorDictBase, hidden: Tensor, window: int) -> Tensor:
    """The controller's actions ``[hidden steps, act]``."""
    now = controller.num_past
    continued = extrapolate_ends(data, window - 1 - now)
    # one window per step of the data, in their order: those that have the step at frame `now`
    frames, _ = WindowTable.build(continued, window, counted=range(now, window - 1), pad_before=now).frames(hidden)
    example = next(itertools.chain(controller.parameters(), controller.buffers()), continued.get(STATE))
    was_training = controller.training
    controller.eval()  # dropout would make labels of noise
    try:
        actions = []
        for part in frames.split(_BATCH):
            states = continued.get(STATE)[part].to(example)  # [B, T, d]
            windows = TensorDict({controller.in_keys[0]: states}, batch_size=states.shape[:-1])
            actions.append(controller(windows).get(controller.out_keys[-1])[:, now].to(frames.device))
    finally:
        controller.train(was_training)
    return torch.cat(actions)
