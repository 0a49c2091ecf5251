# This source code is licensed under the MIT license found in the LICENSE file.
"""Made-up episodes, as rollouts return them."""

import torch
from tensordict import TensorDict


def episode_of(steps, *, success=False, collision=False, mode=3, start=0.0, plans=True):
    """An episode whose position counts its steps; the mode flag is a plain number here."""
    count = start + torch.arange(steps + 1.0)[:, None].expand(-1, 4).contiguous()
    flags = {"success": success, "collision": collision}
    nested = {key: torch.zeros(steps, 1, dtype=torch.bool) for key in flags}
    for key, value in flags.items():
        nested[key][-1] = value
    chunk = {"plan": count[:-1, None, :2].expand(-1, 14, 2)} if plans else {}
    return TensorDict(
        {
            "observation": count[:-1],
            "action": torch.zeros(steps, 2),
            "next": {"observation": count[1:], "mode": torch.full((steps, 1), mode), **nested},
            **chunk,
        },
        [steps],
    )


def number(flags):
    return flags.squeeze(-1)
