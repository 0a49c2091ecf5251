# This source code is licensed under the MIT license found in the LICENSE file.
"""Makes trajectories whose observations hold trajectory and step, and windows whose actions move the state."""

import torch
from tensordict import TensorDict

from torchrl_koap.data import flatten_trajectories

LENGTHS = (20, 33, 16, 40)


def demonstrations(lengths=LENGTHS):
    """Returns flat data with observations (trajectory, step, 0, 0) and actions (trajectory, step)."""
    frames = [
        torch.stack([torch.full((n + 1,), float(i)), torch.arange(n + 1.0), torch.zeros(n + 1), torch.zeros(n + 1)], 1)
        for i, n in enumerate(lengths)
    ]
    return flatten_trajectories(frames, [frame[:-1, :2] for frame in frames])


def seen(batch):
    values = batch["observation"]
    return [(int(w[0, 0]), tuple(int(step) for step in w[:, 1])) for w in values]


def moving_windows():
    """Returns windows of states, with the differences of their first two columns as actions."""
    torch.manual_seed(0)
    state = torch.randn(6, 16, 4).cumsum(1)
    action = torch.cat([state[..., :2].diff(dim=1), torch.full((6, 1, 2), torch.nan)], 1)
    return TensorDict({"state": state, "action": action}, [6])
