# This source code is licensed under the MIT license found in the LICENSE file.
"""The closed loop of a policy without a simulator: how many commands leave their range."""

from __future__ import annotations

from typing import Any

from torchrl_koap.modules import PlanningPolicy


def limited_commands(policy: PlanningPolicy) -> dict[str, Any]:
    """Says how many commands of a policy left the demonstrated range.

    Args:
        policy (PlanningPolicy): one that has acted.

    Returns:
        dict: ``limited_commands``, and a sentence in ``faults`` if there are any.
    """
    limited, commands = policy.limited.tolist()
    if not limited:
        return {"limited_commands": 0}
    margin = policy.execution.limits
    fault = (
        f"{limited} of {commands} commands were farther than {margin:g} of its width outside the demonstrated range and"
        " were held there (limits)"
    )
    return {"limited_commands": limited, "faults": [fault]}
