# This source code is licensed under the MIT license found in the LICENSE file.
"""Whether actions are of the kind that their task declares: changes, or absolute targets of state columns."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

import numpy as np
from tensordict import TensorDictBase

from torchrl_koap import keys
from torchrl_koap.files import some
from torchrl_koap.tasks import Task

NEAR, NAMED = 0.3, 1.0  # share of a column's spread within which its targets lie; likewise if they bear its name
NEARER = 3.0  # times as far from one reading of an action as from the other
FEW, MANY = 20, 20_000  # labels below which nothing is said, and that are looked at


def kind_warnings(data: TensorDictBase, task: Task) -> Iterator[str]:
    """Finds actions that contradict their kind.

    Changes that lie at the next value of a state column look like absolute targets, unless they are velocities by what
    another column does. Absolute targets that lie at the change of their column, per frame or per second, look like
    changes.

    Args:
        data (TensorDictBase): flat data ``[N]`` in the storage layout.
        task (Task): what they are of.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.data import make_demonstrations
        >>> from torchrl_koap.data.action_kinds import kind_warnings
        >>> path = np.sin(np.arange(30.0))[:, None]
        >>> list(kind_warnings(*make_demonstrations([path], [path[1:]], control_hz=10)))[0][:51]
        'actions lie within 0 of state_0 on average: they lo'
    """
    labelled = data.get(keys.HAS_ACTION).squeeze(-1).nonzero().squeeze(-1)
    if len(labelled) < FEW:
        return
    rows = data[labelled[:: 1 + len(labelled) // MANY]]
    before, after, actions = (
        rows.get(key).double().cpu().numpy() for key in (keys.OBSERVATION, keys.NEXT_OBSERVATION, keys.ACTION)
    )
    origin, added = map(np.asarray, task.origins or (0.0, 0.0))
    seen = list(task.state_columns)
    names = [task.observation_names[column] for column in seen]
    level, change = (after + origin)[:, seen], (after - before)[:, seen]
    targets: dict[int, int] = {}
    gaps: list[float] = []
    for index, (name, action) in enumerate(task.actions.items()):
        steps = (actions + added)[:, index, None]
        at, moved, speed = (np.abs(steps - there).mean(0) for there in (level, change, change * task.control_hz))
        if action.kind == "absolute" and action.column is not None:
            near = min(moved[action.column], speed[action.column])
            if NEARER * near < at[action.column]:
                yield (
                    f"absolute action {name!r} is {at[action.column]:.2g} away from its target"
                    f" {names[action.column]!r} on average and {near:.2g} from its change: it looks like a change or a"
                    " velocity; convert again with --action-kind delta"
                )
        elif action.kind == "delta" and speed.min() > NEAR * steps.std():
            share = np.where([column == name for column in names], NAMED, NEAR) * level.std(0)
            fits = np.flatnonzero((at < share) & (NEARER * at < moved))
            if len(fits):
                targets[index] = int(fits[(at / share)[fits].argmin()])
                gaps.append(at[targets[index]])
    if not targets:
        return
    reached = [names[column] for column in targets.values()]
    kinds = ["absolute" if index in targets else action.kind for index, action in enumerate(task.actions.values())]
    asked = " ".join(kinds) if len(targets) < task.action_dim else f"absolute --targets {shlex.join(reached)}"
    yield (
        f"actions lie within {max(gaps):.2g} of {some(reached)} on average: they look like absolute targets; convert"
        f" again with --action-kind {asked}"
    )
