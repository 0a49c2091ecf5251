# This source code is licensed under the MIT license found in the LICENSE file.
"""The closed loop of a policy without a simulator: labels say how states follow actions, by a linear model."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data.trajectories import begins, labelled_episodes, trajectory_lengths
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.evaluation.findings import LEAVES, STAYS, UNSTABLE, loop_faults
from torchrl_koap.files import some
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, OBSERVATION
from torchrl_koap.modules import Agent, ExecutionConfig, PlanningPolicy
from torchrl_koap.modules.execution.agent import FarStateWarning
from torchrl_koap.modules.execution.command_limits import ends_of
from torchrl_koap.modules.ridge import ridge
from torchrl_koap.tasks import Task
from torchrl_koap.training.policy_facts import command_ranges
from torchrl_koap.training.trained import Trained

STEPS, ROBOTS = 300, 16
AWAY = 1e12  # where states have run away: far from what a network's type can square
_FEW, _ASIDE = 5, 0.02  # rollouts that say where all start; share of its range by which a column starts elsewhere
_EXPLAINED = 0.5  # of the variance of changes, below which labels do not say how states follow actions
_SMOOTH = 8  # frames that are averaged before the way of a rollout is measured
_DRIFT = 1.0  # standard deviations that recorded actions may end beside their recording
_ROWS = 4000  # recorded states that distances are measured to
_PREFERRED = 100.0  # weight of actions: in smooth motions the state alone tells how it goes on

# the next change of observations [n, obs]: linear in action, observation and the change before
Response = Callable[[Tensor, Tensor, Tensor], Tensor]


def check_loop(
    trained: Trained,
    data: TensorDictBase,
    labelled: TensorDictBase,
    *,
    execution: ExecutionConfig | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Rolls a policy out on a ridge regression of the change of states, from recorded starts.

    The policy acts without limits first; if a command leaves its range, it acts once more with them. The ridge is
    fitted to all labels of the flat data ``[N]``; the demonstrated commands are those of the budget (``labelled``).

    Returns:
        dict: ``steps``, ``robots``, ``explained`` (share of the changes' variance on labels left out),
        ``largest_command`` and ``largest_command_late`` (in the last third), over the largest demonstrated one,
        ``distance_to_demonstrations`` (late, 95 % quantile, standard deviations), ``share_of_way`` (how far it
        gets from its starts, over how far demonstrations get, medians), ``limited_commands``, ``commands``, and
        sentences in ``faults``; or a ``note`` that says why there is none.
    """
    task = trained.task
    ranges = command_ranges(task, labelled)
    if not any(ranges):
        return {"note": "no command changes in the labels", "faults": []}
    response, explained = _fit(data)
    if explained < _EXPLAINED:
        share = f"{max(explained, 0):.0%} of how all state columns change, which is too little"
        return {"note": f"a linear model explains {share}", "faults": []}
    if not _replay_error(response, data) < _DRIFT:
        return {"note": "recorded actions do not lead along their recording in the linear model", "faults": []}
    asked = (execution or ExecutionConfig()).on(trained.execution)
    trained = replace(trained, cameras={})  # labels hold embeddings
    free = trained.policy(asked.replaced(limits=math.inf))
    steps = min(STEPS, task.max_steps)
    commands, *where = _roll(free, response, data, steps, seed)
    growth, late = _growth(commands, ends_of(ranges), steps)
    if late > UNSTABLE:
        # actions of an expert that knew the states without noise tell that noise: states then explain changes wrongly
        other, others_share = _fit(data, by_states=False)
        if others_share >= _EXPLAINED and _replay_error(other, data) < _DRIFT:
            again = _roll(free, other, data, steps, seed)
            grown = _growth(again[0], ends_of(ranges), steps)
            if grown[1] < late:
                response, explained = other, others_share
                (commands, *where), (growth, late) = again, grown
    policy = trained.policy(asked)
    if policy.limits is not None and growth.max() > 1:
        _, *where = _roll(policy, response, data, steps, seed)
    limited = int(policy.limited[0])
    found = {
        "steps": steps,
        "robots": commands.shape[1],
        "explained": explained,
        "largest_command": min(float(growth.max()), 1e30),
        "largest_command_late": min(late, 1e30),
        "distance_to_demonstrations": where[0],
        "share_of_way": where[1],
        "limited_commands": limited,
        "commands": steps * commands.shape[1],
    }
    return found | {"faults": loop_faults(found)}


def _growth(commands: Tensor, ends: Tensor, steps: int) -> tuple[Tensor, float]:
    """Commands ``[T, n, act]`` over the largest demonstrated ones ``[T, n]``, and the largest of the last third."""
    growth = ((commands - ends.mean(-1)) / (ends.diff(dim=-1).squeeze(-1) / 2)).nan_to_num(math.inf).abs()
    growth = growth[..., ends[:, 0].isfinite()].amax(-1)
    return growth, float(growth[2 * len(growth) // 3 :].max()) if len(growth) == steps else math.inf


def limited_commands(policy: PlanningPolicy) -> dict[str, Any]:
    """Says how many commands of a policy left the demonstrated range, with a sentence in ``faults`` if any did."""
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
    """Says how many failed rollouts ``[T]`` hardly leave their start, in most columns, against demonstrations."""

    def way(rows: Tensor) -> Tensor:
        smooth = rows.double().unfold(0, min(_SMOOTH, len(rows)), 1).mean(-1)  # sensor noise is no way
        return (smooth - smooth[:1]).abs().amax(0)

    recorded = data[OBSERVATION].split(trajectory_lengths(data).tolist())
    usual = torch.stack([way(rows) for rows in recorded]).median(0).values
    ways = [way(episode[OBSERVATION]) / usual for episode in failed if len(episode) >= _SMOOTH]
    stay = sum(bool(each[usual > 0].median() < STAYS) for each in ways)
    said = f"{stay} of {len(failed)} failed rollouts get less than {STAYS:g} times as far from their start as"
    return [f"{said} demonstrations; {LEAVES}"] if stay else []


def start_faults(rollouts: Sequence[TensorDictBase], data: TensorDictBase, task: Task) -> list[str]:
    """Names columns in which nine in ten of at least five rollouts ``[T]`` start on one side of all recordings."""
    if len(rollouts) < _FEW:
        return []
    observed = data[OBSERVATION].double()
    (low, high), (least, most) = (torch.aminmax(rows, dim=0) for rows in (observed[begins(data)], observed))
    seen = torch.stack([episode[OBSERVATION][0].double() for episode in rollouts])
    room = _ASIDE * (most - least)
    out = (seen.quantile(0.1, 0) > high + room) | (seen.quantile(0.9, 0) < low - room)
    origin = torch.tensor((task.origins or (0.0,))[0], dtype=torch.float64)
    table = torch.stack([seen.median(0).values, low, high], -1) + origin.unsqueeze(-1)
    rows = [(task.observation_names[column], *table[column].tolist()) for column in out.nonzero().flatten().tolist()]
    said = some([f"{name} at {start:.4g} (recordings: {low:.4g} to {high:.4g})" for name, start, low, high in rows])
    return [f"rollouts start where no recording does: {said}: another zero, unit or order of columns?"] if rows else []


def _fit(data: TensorDictBase, *, by_states: bool = True) -> tuple[Response, float]:
    """The ridge of all labelled steps that have one before them; with or without the observations themselves.

    Beside it stands the share of the changes' variance that it explains on labels left out.
    """
    episode, observed = data[EPISODE], data[OBSERVATION].double()
    changes = data["next", OBSERVATION].double() - observed
    rows = (data[HAS_ACTION].squeeze(-1) & ~begins(data)).nonzero().squeeze(-1)
    action = data[ACTION][rows].double()
    seen, size = observed[rows], changes[rows].std(0, correction=0)
    moving = size > 1e-9 * seen.abs().amax(0)  # goals move no robot
    scales = tuple(
        torch.where(scale > 0, scale, 1.0)
        for scale in (
            action.square().mean(0).sqrt() / _PREFERRED,
            torch.where(moving, seen.std(0, correction=0), math.inf) if by_states else torch.full_like(size, math.inf),
            changes[rows].square().mean(0).sqrt(),
        )
    )

    def scaled(*parts: Tensor) -> Tensor:
        return torch.cat([part / size for part, size in zip(parts, scales, strict=True)], -1)

    def step(observed: Tensor, change: Tensor, action: Tensor) -> Tensor:
        return torch.nn.functional.linear(scaled(action, observed, change), weight, bias)

    inputs = scaled(action, seen, changes[rows - 1])
    wanted = changes[rows]
    fit = ridge(inputs, wanted[:, moving] / size[moving], groups=episode[rows], penalties=[1e-9, 1e-7, 1e-5, 1e-3, 0.1])
    weight, bias = torch.zeros(observed.shape[-1], inputs.shape[-1]).double(), wanted.mean(0)
    weight[moving], bias[moving] = fit.weight * size[moving, None], fit.bias * size[moving]
    return step, 1 - fit.error**2


def _replay_error(response: Response, data: TensorDictBase) -> float:
    """How far recorded actions end beside their recordings, in standard deviations: the median of trajectories."""
    spread = _spread(data)
    apart = []
    for number in labelled_episodes(data)[:ROBOTS].tolist():
        rows = data[(data[EPISODE] == number) & data[HAS_ACTION].squeeze(-1)][:STEPS]
        frames, action = rows[OBSERVATION].double(), rows[ACTION].double()
        if len(rows) < 3:
            continue
        now, change = frames[1], frames[1] - frames[0]
        for step in range(1, len(rows) - 1):
            change = response(now, change, action[step])
            now = now + change
        apart.append(float(((now - frames[-1]) / spread).square().mean().sqrt()))
    return statistics.median_high(apart) if apart else math.inf


def _roll(
    policy: PlanningPolicy, response: Response, data: TensorDictBase, steps: int, seed: int
) -> tuple[Tensor, float, float]:
    """Commands ``[steps, n, act]``, fewer where they are no numbers any more, and where the robots get.

    The distance to recorded states, and the share of the way that the demonstrations take.
    """
    observed, first = data[OBSERVATION].double(), begins(data)
    starts = (first.roll(1) & ~first & (observed + observed.roll(1, 0)).isfinite().all(-1)).nonzero().squeeze(-1)
    starts = spread_evenly(starts, ROBOTS)
    now, change = observed[starts], observed[starts] - observed[starts - 1]
    agent, commands, visited = Agent(policy, seed=seed), [], []
    agent.reset()
    origin, added = policy.origins or (0.0, 0.0)  # the agent reads and tells the robot's numbers
    for _ in range(steps):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FarStateWarning)  # the distance to recorded states tells it
            action = agent.act(now + origin).double().cpu() - added
        change = response(now, change, action)
        now = now + change
        commands.append(action)
        visited.append(now)
        if not (now.abs() < AWAY).all():
            return torch.stack(commands), math.inf, math.inf
    spread, recorded = _spread(data), observed[observed.isfinite().all(-1)]
    ways = [observed[data[EPISODE] == number][1 : steps + 2] for number in data[EPISODE][starts].tolist()]
    usual = torch.stack([_way(rows - rows[:1], spread) for rows in ways]).median()
    own = torch.stack([_way(rows, spread) for rows in (torch.stack(visited) - observed[starts]).unbind(1)]).median()
    recorded = recorded[:: -(-len(recorded) // _ROWS)] / spread
    last = torch.cat(visited[2 * steps // 3 :: 5]) / spread
    nearest = torch.cdist(last, recorded).amin(-1) / math.sqrt(recorded.shape[-1])
    return torch.stack(commands), float(nearest.quantile(0.95)), float(own / usual) if usual > 0 else 1.0


def _way(moved: Tensor, spread: Tensor) -> Tensor:
    """The farthest that rows ``[T, obs]`` of differences are from 0, in standard deviations."""
    return (moved / spread).nan_to_num().norm(dim=-1).max()


def _spread(data: TensorDictBase) -> Tensor:
    """Standard deviations of the recorded observations ``[obs]``, 1 for a column that never changes."""
    observed = data[OBSERVATION].double()
    spread = observed[observed.isfinite().all(-1)].std(0, correction=0)
    return torch.where(spread > 0, spread, 1.0)
