# This source code is licensed under the MIT license found in the LICENSE file.
"""Says what is odd in rollouts: limited commands, policies that stand still or stall, starts that no recording has."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data.trajectories import begins, trajectory_lengths
from torchrl_koap.evaluation.findings import LEAVES, STAYS
from torchrl_koap.files import some
from torchrl_koap.keys import OBSERVATION
from torchrl_koap.modules import PlanningPolicy
from torchrl_koap.tasks import Task

_MIN_ROLLOUTS, _START_MARGIN = 5, 0.02  # to compare starts; tolerance, as a share of the range of the column
_SMOOTH = 8  # frames that are averaged before distances from the start are measured
_NEAR, _LONGER, _COMPARED = 0.5, 2.0, 200  # stalls: spreads of a column; times as long; recordings that are compared


def limited_commands(policy: PlanningPolicy) -> dict[str, Any]:
    """Counts the commands of a policy that left the demonstrated range; ``faults`` has a sentence if any did."""
    limited, commands = policy.limited.tolist()
    if not limited:
        return {"limited_commands": 0}
    margin = policy.execution.limits
    fault = (
        f"{limited} of {commands} commands left the demonstrated range by more than {margin:g} of its width and were"
        " limited there; --limits inf sends them as they are"
    )
    return {"limited_commands": limited, "faults": [fault]}


def standing_faults(failed: Sequence[TensorDictBase], data: TensorDictBase) -> list[str]:
    """Reports failed rollouts ``[T]`` that, in most columns, hardly leave their start compared to demonstrations."""

    def reach(rows: Tensor) -> Tensor:
        smooth = rows.double().unfold(0, min(_SMOOTH, len(rows)), 1).mean(-1)  # sensor noise is not motion
        return (smooth - smooth[:1]).abs().amax(0)

    recorded = data[OBSERVATION].split(trajectory_lengths(data).tolist())
    usual = torch.stack([reach(rows) for rows in recorded]).median(0).values
    ways = [reach(episode[OBSERVATION]) / usual for episode in failed if len(episode) >= _SMOOTH]
    stay = sum(bool(each[usual > 0].median() < STAYS) for each in ways)
    said = f"{stay} of {len(failed)} failed rollouts get less than {STAYS:g} times as far from their start as"
    return [f"{said} demonstrations; {LEAVES}"] if stay else []


def stall_faults(failed: Sequence[TensorDictBase], data: TensorDictBase) -> list[str]:
    """Reports failed rollouts ``[T]`` that stay near one observation twice as long as the slowest demonstration."""
    observed = data[OBSERVATION].double()
    spread = torch.where(observed.std(0) > 0, observed.std(0), torch.inf)

    def longest(rows: Tensor) -> int:
        """Counts the most steps in which no column leaves its value by half of its spread."""
        places, first, most = (rows / spread).numpy(), 0, 0
        while first < len(places):
            away = (np.abs(places[first:] - places[first]) > _NEAR).any(1)
            steps = int(away.argmax()) if away.any() else len(away)
            first, most = first + steps, max(most, steps)
        return most

    recorded = observed.split(trajectory_lengths(data).tolist())
    usual = max(map(longest, recorded[:: -(-len(recorded) // _COMPARED)]))
    stalls = [steps for episode in failed if (steps := longest(episode[OBSERVATION].double())) > _LONGER * usual]
    if not stalls:
        return []
    said = f"{len(stalls)} of {len(failed)} failed rollouts stall: they stay near one observation for"
    return [
        f"{said} {int(np.median(stalls))} steps (median), demonstrations for at most {usual}: none shows how to go"
        " on from there; record some that start there or shortly before"
    ]


def start_faults(rollouts: Sequence[TensorDictBase], data: TensorDictBase, task: Task) -> list[str]:
    """Names columns in which 90 % of at least five rollouts ``[T]`` start outside the range of recorded starts."""
    if len(rollouts) < _MIN_ROLLOUTS:
        return []
    observed = data[OBSERVATION].double()
    (low, high), (least, most) = (torch.aminmax(rows, dim=0) for rows in (observed[begins(data)], observed))
    seen = torch.stack([episode[OBSERVATION][0].double() for episode in rollouts])
    margin = _START_MARGIN * (most - least)
    out = ((seen > high + margin) | (seen < low - margin)).double().mean(0) >= 0.9
    origin = torch.tensor((task.origins or (0.0,))[0], dtype=torch.float64)
    table = torch.stack([*torch.aminmax(seen, dim=0), low, high], -1) + origin.unsqueeze(-1)
    rows = [(task.observation_names[column], *table[column].tolist()) for column in out.nonzero().flatten().tolist()]
    said = some([f"{name} at {a:.4g} to {b:.4g} (recordings: {c:.4g} to {d:.4g})" for name, a, b, c, d in rows])
    return [f"rollouts start where no recording does: {said}: another zero, unit or order of columns?"] if rows else []
