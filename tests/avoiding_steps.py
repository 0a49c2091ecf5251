# This source code is licensed under the MIT license found in the LICENSE file.
"""Single steps of Avoiding, and an action that runs into a cylinder."""

from __future__ import annotations

import torch
from tensordict import TensorDict

# head on into the cylinder of the first row
INTO_ROW_1 = torch.tensor([-0.0010, 0.010], dtype=torch.float64)


def act(env, action, mask=None):
    tensordict = TensorDict({"action": action.expand(env.batch_size[0], 2).to(env._dtype)}, env.batch_size)
    if mask is not None:
        tensordict["_step"] = torch.as_tensor(mask).reshape(-1, 1)
    return env.step(tensordict)["next"]
