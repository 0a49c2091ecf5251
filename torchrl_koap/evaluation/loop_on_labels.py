# This source code is licensed under the MIT license found in the LICENSE file.
"""The closed loop of a policy without a simulator: a linear model, fitted to labels, predicts the next state."""

from __future__ import annotations

import math
import statistics
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_koap.data.trajectories import begins, labelled_episodes
from torchrl_koap.data.windows import spread_evenly
from torchrl_koap.evaluation.findings import UNSTABLE, loop_faults
from torchrl_koap.keys import ACTION, EPISODE, HAS_ACTION, OBSERVATION
from torchrl_koap.modules import Agent, ExecutionConfig, PlanningPolicy
from torchrl_koap.modules.execution.agent import FarStateWarning
from torchrl_koap.modules.execution.command_limits import ends_of
from torchrl_koap.modules.ridge import ridge
from torchrl_koap.training.policy_facts import command_ranges, varied
from torchrl_koap.training.trained import Trained

STEPS, ROBOTS = 300, 16
DIVERGED = 1e12  # a rollout ends if a column exceeds this, far below values whose squares overflow in a network
_EXPLAINED = 0.5  # smallest share of the variance of changes that a usable linear model explains
_DRIFT = 1.0  # standard deviations; replayed actions must end nearer to their recording
_ROWS = 4000  # largest number of recorded states that distances are measured to
_PREFERRED = 100.0  # weight of actions in the ridge: in smooth motions the state alone predicts the next one

# the next change of observations [n, obs], linear in action, observation and previous change
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

    The policy acts without limits first. If a command leaves its range, the rollout is repeated with limits. The ridge
    is fitted to all labels of the flat data ``[N]``; the demonstrated commands are those of the budget (``labelled``).

    Returns:
        dict: ``steps``, ``robots``, ``explained`` (share of the changes' variance on labels left out),
        ``largest_command`` and ``largest_command_late`` (in the last third), relative to the largest demonstrated one,
        ``distance_to_demonstrations`` (last third, 95 % quantile, standard deviations), ``share_of_way`` (largest
        distance from the start, relative to that of demonstrations, medians), ``limited_commands``, ``commands``, and
        sentences in ``faults``. If the loop cannot be judged, a ``note`` says why.
    """
    task = trained.task
    ranges = varied(command_ranges(task, labelled))
    if not any(ranges) or not (data[HAS_ACTION] & ~begins(data).unsqueeze(-1)).any():
        return {"note": "no command changes in the labels", "faults": []}
    if not (stretches := _labelled_stretches(data)):
        return {"note": "no recording has three labelled steps in a row, so no actions can be replayed", "faults": []}
    response, explained = _fit(data)
    if explained < _EXPLAINED:
        share = f"{max(explained, 0):.0%} of how all state columns change, which is too little"
        return {"note": f"a linear model explains {share}", "faults": []}
    spread = _spread(data)
    if not _replay_error(response, stretches, spread) < _DRIFT:
        return {"note": "in the linear model, recorded actions do not reproduce their recordings", "faults": []}
    asked = (execution or ExecutionConfig()).on(trained.execution)
    trained = replace(trained, cameras={})  # data hold embeddings, not pictures
    free = trained.policy(asked.replaced(limits=math.inf))
    steps = min(STEPS, task.max_steps)
    commands, *reached = _roll(free, response, data, steps, seed)
    growth, late = _growth(commands, ends_of(ranges), steps)
    if late > UNSTABLE:
        # an expert acts on states without sensor noise: its actions reveal the noise and bias a fit on noisy states
        without_states, its_share = _fit(data, by_states=False)
        if its_share >= _EXPLAINED and _replay_error(without_states, stretches, spread) < _DRIFT:
            again = _roll(free, without_states, data, steps, seed)
            other_growth = _growth(again[0], ends_of(ranges), steps)
            if other_growth[1] < late:
                response, explained = without_states, its_share
                (commands, *reached), (growth, late) = again, other_growth
    policy = trained.policy(asked)
    if policy.limits is not None and growth.max() > 1:
        _, *reached = _roll(policy, response, data, steps, seed)
    limited = int(policy.limited[0])
    found = {
        "steps": steps,
        "robots": commands.shape[1],
        "explained": explained,
        "largest_command": min(float(growth.max()), 1e30),
        "largest_command_late": min(late, 1e30),
        "distance_to_demonstrations": reached[0],
        "share_of_way": reached[1],
        "limited_commands": limited,
        "commands": steps * commands.shape[1],
    }
    return found | {"faults": loop_faults(found)}


def _growth(commands: Tensor, ends: Tensor, steps: int) -> tuple[Tensor, float]:
    """Returns the largest ratios ``[T, n]`` of commands to demonstrated ones, and their maximum in the last third."""
    growth = ((commands - ends.mean(-1)) / (ends.diff(dim=-1).squeeze(-1) / 2)).nan_to_num(math.inf).abs()
    growth = growth[..., ends[:, 0].isfinite()].amax(-1)
    return growth, float(growth[2 * len(growth) // 3 :].max()) if len(growth) == steps else math.inf


def _fit(data: TensorDictBase, *, by_states: bool = True) -> tuple[Response, float]:
    """Fits a ridge to all labelled steps except first ones; ``by_states`` makes observations an input too.

    Returns the model and the share of the changes' variance that it explains on labels left out.
    """
    episode, observed = data[EPISODE], data[OBSERVATION].double()
    changes = data["next", OBSERVATION].double() - observed
    rows = (data[HAS_ACTION].squeeze(-1) & ~begins(data)).nonzero().squeeze(-1)
    action = data[ACTION][rows].double()
    seen, size = observed[rows], changes[rows].std(0, correction=0)
    moving = size > 1e-9 * seen.abs().amax(0)  # leaves out constant columns, such as goals
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


def _labelled_stretches(data: TensorDictBase) -> list[TensorDictBase]:
    """Returns the longest unbroken stretch of labels of each trajectory, of at least three steps."""
    longest = []
    for number in labelled_episodes(data)[:ROBOTS].tolist():
        rows = data[data[EPISODE] == number]
        labelled, lengths = rows[HAS_ACTION].squeeze(-1).unique_consecutive(return_counts=True)
        stretches = zip(labelled.tolist(), rows.split(lengths.tolist()), strict=True)
        longest.append(max((part for known, part in stretches if known), key=len)[:STEPS])
    return [rows for rows in longest if len(rows) >= 3]


def _replay_error(response: Response, stretches: list[TensorDictBase], spread: Tensor) -> float:
    """Returns how far replayed actions end from their recordings (median of stretches, standard deviations)."""
    apart = []
    for rows in stretches:
        frames, action = rows[OBSERVATION].double(), rows[ACTION].double()
        now, change = frames[1], frames[1] - frames[0]
        for step in range(1, len(rows) - 1):
            change = response(now, change, action[step])
            now = now + change
        apart.append(float(((now - frames[-1]) / spread).square().mean().sqrt()))
    return statistics.median_high(apart)


def _roll(
    policy: PlanningPolicy, response: Response, data: TensorDictBase, steps: int, seed: int
) -> tuple[Tensor, float, float]:
    """Rolls a policy out on a linear model: commands ``[steps, n, act]``, fewer if states diverge.

    Also returns the distance to recorded states and the distance from the start relative to demonstrations.
    """
    observed, first = data[OBSERVATION].double(), begins(data)
    starts = (first.roll(1) & ~first & (observed + observed.roll(1, 0)).isfinite().all(-1)).nonzero().squeeze(-1)
    starts = spread_evenly(starts, ROBOTS)
    now, change = observed[starts], observed[starts] - observed[starts - 1]
    agent, commands, visited = Agent(policy, seed=seed), [], []
    agent.reset()
    origin, added = policy.origins or (0.0, 0.0)  # the agent reads and returns values as the robot reports them
    for _ in range(steps):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FarStateWarning)  # the distance to recorded states reports it
            action = agent.act(now + origin).double().cpu() - added
        change = response(now, change, action)
        now = now + change
        commands.append(action)
        visited.append(now)
        if not (now.abs() < DIVERGED).all():
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
    """Returns the largest norm of differences ``[T, obs]``, in standard deviations."""
    return (moved / spread).nan_to_num().norm(dim=-1).max()


def _spread(data: TensorDictBase) -> Tensor:
    """Returns standard deviations of the recorded observations ``[obs]``, 1 for a constant column."""
    observed = data[OBSERVATION].double()
    spread = observed[observed.isfinite().all(-1)].std(0, correction=0)
    return torch.where(spread > 0, spread, 1.0)
