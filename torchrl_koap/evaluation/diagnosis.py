# This source code is licensed under the MIT license found in the LICENSE file.
"""Which part of a policy fails: planner, controller, or the data.

Three success rates separate them. The planner alone continues its own plans: the executed part of each becomes the
next history, nothing is simulated. The controller alone follows the recorded states of demonstrations, as if the
planner were perfect. Both together are the closed loop.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torchrl_koap.data.trajectories import labelled_episodes, trajectory_lengths
from torchrl_koap.evaluation.rollouts import device_of, observations_of, roll_out
from torchrl_koap.keys import EPISODE, OBSERVATION, PLAN, STATE
from torchrl_koap.modules import PlanningPolicy, StatePlanner
from torchrl_koap.tasks import Task
from torchrl_koap.tasks.columns import unit_groups

_MOST_STATES = 4000  # whose distances are measured
RECORDED_FUTURE = "recorded_future"
RECORDED = "recorded"  # steps whose next state the recording that is followed has, not the standing at its end


def hand_on(futures: Tensor) -> TensorDictModule:
    """Writes the recorded states ``[E, steps, H, d]`` after the current step, the last ones when a record is over."""
    steps = itertools.chain(futures.unbind(1), itertools.repeat(futures[:, -1]))
    return TensorDictModule(steps.__next__, in_keys=[], out_keys=[RECORDED_FUTURE])


class RecordedPlanner(nn.Module):
    """Hands on the recorded future in place of plans, with history and horizon of a planner."""

    noise_key = RECORDED_FUTURE  # what a policy hands over is no noise here

    def __init__(self, planner: StatePlanner):
        super().__init__()
        self.history, self.horizon = planner.history, planner.horizon

    def sample(self, history: Tensor, future: Tensor) -> Tensor:
        """The futures ``[*B, H, d]`` that :func:`hand_on` writes, of histories ``[*B, h, d]``."""
        return future.expand(*history.shape[:-2], -1, -1)


@torch.no_grad()
def planner_rollout(planner: StatePlanner, start: Tensor, *, interval: int, max_steps: int, seed: int = 0) -> Tensor:
    """Lets a planner continue its own plans, of each of which ``interval`` states are taken over.

    Returned are planned states ``[E, max_steps, d]`` (or a few more), the first one the start ``[E, d]``.
    """
    generator = torch.Generator().manual_seed(seed)
    states = [start] * planner.history
    while len(states) - planner.history < max_steps - 1:
        history = torch.stack(states[-planner.history :], -2)
        noise = torch.randn(len(start), *planner.noise_shape, generator=generator)
        states += planner.sample(history, noise.to(start.device))[:, :interval].unbind(1)
    return torch.stack(states[planner.history - 1 :], 1)


def contexts_of(task: Task, observation: Tensor) -> Tensor:
    """Finds the contexts ``[E, objects, 3]`` (x, y in m, yaw in rad) that first observations ``[E, obs]`` show.

    ``tan(yaw)`` gives the yaw of a box up to half a turn, which looks the same.
    """
    rows = []
    for body in task.bodies:
        xy = observation[:, task.observation[body.position]][:, :2]
        turned = observation[:, task.observation[body.yaw]] if body.yaw else xy.new_zeros(len(xy), 1)
        if turned.shape[-1] == 4:
            w, _, _, z = turned.unbind(-1)
            yaw = 2 * torch.atan2(z * w.sign(), w.abs())
        else:
            yaw = turned.squeeze(-1).atan()
        rows.append(torch.cat([xy, yaw[:, None]], -1))
    return torch.stack(rows, 1)


def recorded_futures(states: Sequence[Tensor], horizon: int) -> Tensor:
    """Stacks the states ``[E, max T, H, d]`` after every step of trajectories ``[T_i, d]``, their last one repeated."""
    longest = max(len(path) for path in states)
    ahead = torch.arange(longest)[:, None] + torch.arange(1, horizon + 1)
    return torch.stack([path[ahead.clamp_max(len(path) - 1)] for path in states])


def follow_recordings(
    policy: PlanningPolicy, task: Task, data: TensorDictBase, make_env: Callable[[int], Any], *, episodes: int
) -> list[TensorDict]:
    """Rolls out a policy with recorded states in place of plans, one episode for each of as many demonstrations.

    They are spread evenly over the data; where some have no action at all, as those of another embodiment, only the
    others are followed. Episodes have the entry :data:`RECORDED` ``[T, 1]``.
    """
    lengths = trajectory_lengths(data).tolist()
    own = torch.isin(data[EPISODE].unique_consecutive(), labelled_episodes(data)).nonzero().squeeze(-1)
    own = own if len(own) else torch.arange(len(lengths))
    chosen = own[torch.linspace(0, len(own) - 1, min(episodes, len(own))).long().unique()].tolist()
    paths = data[STATE].split(lengths)
    starts = torch.stack([data[OBSERVATION].split(lengths)[index][0] for index in chosen])
    planner = RecordedPlanner(policy.planner)
    perfect = PlanningPolicy(
        planner,
        policy.follower,
        state_of=policy.state_of,
        execution=policy.execution.replaced(temperature=1.0),  # futures come as noise
        limits=policy.limits,
    ).to(device_of(policy))
    futures = recorded_futures([paths[index] for index in chosen], planner.horizon)
    followed = roll_out(
        perfect,
        make_env,
        list(range(len(chosen))),
        max_steps=task.max_steps,
        contexts=contexts_of(task, starts.double()).numpy() if task.objects else None,
        given=lambda part: hand_on(futures[part].to(device_of(policy))),
    )
    for episode, index in zip(followed, chosen, strict=True):
        episode[RECORDED] = (torch.arange(len(episode)) < len(paths[index]) - 1).unsqueeze(-1)
    return followed


def tracking_errors(task: Task, episodes: Sequence[TensorDict], interval: int) -> dict[str, list[float]]:
    """Measures how far executed states lie from the current plan, per part of the state, in its units.

    These are root mean square distances per step ``1 .. interval`` after a plan; none of rollouts ``[T]`` without the
    entry ``plan``. A part whose columns have several units has an entry for each, such as ``"arm (rad)"``. Of rollouts
    that follow a recording the steps count that it has, not the standing at its end.
    """
    columns_of = _columns_by_unit(task)
    errors: dict[str, list[Tensor]] = {name: [] for name in columns_of}
    for episode in episodes:
        if PLAN not in episode.keys():
            return {}
        if RECORDED in episode.keys():
            episode = episode[episode[RECORDED].squeeze(-1)]
        states = task.state_of(observations_of(episode))
        made = torch.arange(0, max(len(episode) - interval + 1, 0), interval)
        steps = torch.arange(1, interval + 1)
        gap = states[made[:, None] + steps] - episode[PLAN][made, :interval]
        for name, columns in columns_of.items():
            errors[name].append(gap[..., columns].square().sum(-1))
    return {name: torch.cat(parts).mean(0).sqrt().tolist() for name, parts in errors.items() if parts}


def _columns_by_unit(task: Task) -> dict[str, slice | list[int]]:
    """Columns of the state by its parts, those of one with several units apart."""
    found: dict[str, slice | list[int]] = {}
    for name, columns in task.state_slices.items():
        units = unit_groups(task.state_units[columns])
        if len(units) == 1:
            found[name] = columns
        else:
            for unit, places in units.items():
                found[f"{name} ({unit or 'no unit'})"] = [columns.start + place for place in places]
    return found


def of_position(task: Task, errors: Mapping[str, list[float]]) -> list[float] | None:
    """Returns those of :func:`tracking_errors` that are of the tool's position, None where the state shows none."""
    return errors.get(task.position, errors.get(f"{task.position} (m)"))


def left_recordings(task: Task, episodes: Sequence[TensorDict], interval: int, *, beyond: float) -> int:
    """Counts the recorded tool paths from which a controller is further than ``beyond`` (m, root mean square).

    Looked at is the step ``interval`` after each plan, in rollouts of :func:`follow_recordings`.
    """
    errors = [of_position(task, tracking_errors(task, [episode], interval)) for episode in episodes]
    return sum(error[-1] > beyond for error in errors if error)


def distance_to_demonstrations(task: Task, episodes: Sequence[TensorDict], data: TensorDictBase) -> dict[str, float]:
    """Measures how far visited states are from the nearest demonstrated one, and demonstrated ones, in spreads.

    Every second demonstration is compared with the others, so that both figures are distances to strangers: their 95 %
    quantiles. Nothing is measured if there is a single demonstration.
    """
    every = data[EPISODE] % 2 == 0
    known, held_out = data[STATE][every], data[STATE][~every]
    if not len(held_out):
        return {}
    scale = known.std(0).clamp_min(1e-6) * task.state_dim**0.5
    visited = torch.cat([task.state_of(episode[OBSERVATION]) for episode in episodes])
    known, found = known[:: max(1, len(known) // 20000)] / scale, {}
    for name, states in {"visited_95": visited, "demonstrated_95": held_out}.items():
        parts = (states[:: max(1, len(states) // _MOST_STATES)] / scale).split(2048)
        found[name] = torch.cat([torch.cdist(part, known).amin(1) for part in parts]).quantile(0.95).item()
    return found
