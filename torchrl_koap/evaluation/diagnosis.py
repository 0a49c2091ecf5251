# This source code is licensed under the MIT license found in the LICENSE file.
"""Which part of a policy fails: planner, controller, or the data.

Three success rates separate them. The planner alone continues its own plans without simulation: the executed part of
each plan becomes the next history. The controller alone follows the recorded states of demonstrations, as if the
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

_MOST_STATES = 4000  # largest number of states whose distances are measured
_ELSEWHERE = 0.2  # share of the range of a column: noise is below, independent draws of a goal are above
RECORDED_FUTURE = "recorded_future"
RECORDED = "recorded"  # marks steps whose next state is recorded; after the end, its last state is repeated


def hand_on(futures: Tensor) -> TensorDictModule:
    """Writes the recorded futures ``[E, steps, H, d]`` of one step per call; repeats the last ones at the end."""
    steps = itertools.chain(futures.unbind(1), itertools.repeat(futures[:, -1]))
    return TensorDictModule(steps.__next__, in_keys=[], out_keys=[RECORDED_FUTURE])


class RecordedPlanner(nn.Module):
    """Returns recorded futures as plans, with history and horizon of a planner."""

    noise_key = RECORDED_FUTURE  # the policy passes this entry to sample() in place of noise

    def __init__(self, planner: StatePlanner):
        super().__init__()
        self.history, self.horizon = planner.history, planner.horizon

    def sample(self, history: Tensor, future: Tensor) -> Tensor:
        """Returns the futures ``[*B, H, d]`` of :func:`hand_on` for histories ``[*B, h, d]``."""
        return future.expand(*history.shape[:-2], -1, -1)


@torch.no_grad()
def planner_rollout(planner: StatePlanner, start: Tensor, *, interval: int, max_steps: int, seed: int = 0) -> Tensor:
    """Lets a planner continue its own plans; each contributes its first ``interval`` states.

    Returns planned states ``[E, max_steps, d]`` (or a few more), which begin with the start ``[E, d]``.
    """
    generator = torch.Generator().manual_seed(seed)
    states = [start] * planner.history
    while len(states) - planner.history < max_steps - 1:
        history = torch.stack(states[-planner.history :], -2)
        noise = torch.randn(len(start), *planner.noise_shape, generator=generator)
        states += planner.sample(history, noise.to(start.device))[:, :interval].unbind(1)
    return torch.stack(states[planner.history - 1 :], 1)


def contexts_of(task: Task, observation: Tensor) -> Tensor:
    """Reads the contexts ``[E, objects, 3]`` (x, y in m, yaw in rad) from first observations ``[E, obs]``.

    ``tan(yaw)`` gives the yaw of a box up to half a turn, after which the box looks the same.
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
    """Stacks the states ``[E, max T, H, d]`` after every step of trajectories ``[T_i, d]``; repeats the last one."""
    longest = max(len(path) for path in states)
    ahead = torch.arange(longest)[:, None] + torch.arange(1, horizon + 1)
    return torch.stack([path[ahead.clamp_max(len(path) - 1)] for path in states])


def follow_recordings(
    policy: PlanningPolicy, task: Task, data: TensorDictBase, make_env: Callable[[int], Any], *, episodes: int
) -> list[TensorDict]:
    """Rolls out a policy with recorded states in place of plans, one episode per chosen demonstration.

    At most ``episodes`` demonstrations are chosen, spread evenly over the data. Those without actions, for example of
    another embodiment, are skipped if others have some. Episodes have the entry :data:`RECORDED` ``[T, 1]``. Returns
    none if episodes start elsewhere than their demonstrations, on average by more than 20 % of the range of a column:
    an environment may draw goals that are no bodies of the task.
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
        execution=policy.execution.replaced(temperature=1.0, candidates=1),  # futures replace noise
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
    span = data[STATE].amax(0) - data[STATE].amin(0)
    begun = torch.stack([task.state_of(episode[OBSERVATION][0]) for episode in followed])
    away = (begun - torch.stack([paths[index][0] for index in chosen])).abs().mean(0)
    if not task.objects and ((away > _ELSEWHERE * span) & (span > 0)).any():
        return []
    for episode, index in zip(followed, chosen, strict=True):
        episode[RECORDED] = (torch.arange(len(episode)) < len(paths[index]) - 1).unsqueeze(-1)
    return followed


def tracking_errors(task: Task, episodes: Sequence[TensorDict], interval: int) -> dict[str, list[float]]:
    """Measures how far executed states lie from the current plan, per part of the state and unit.

    Returns root mean square distances per step ``1 .. interval`` after a plan, with names such as ``"arm (rad)"``; none
    if rollouts ``[T]`` lack the entry ``plan``. In rollouts that follow a recording, only steps before its end count.
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


def _columns_by_unit(task: Task) -> dict[str, list[int]]:
    """Returns the state columns of each part with the same unit, by the names of both; features of angles have none."""
    return {
        f"{name} ({unit or 'no unit'})": [columns.start + place for place in places]
        for name, columns in task.state_slices.items()
        for unit, places in unit_groups(task.state_units[columns]).items()
    }


def of_position(task: Task, errors: Mapping[str, list[float]]) -> list[float] | None:
    """Returns the :func:`tracking_errors` of the tool's position; None if the state does not hold it in m."""
    return errors.get(f"{task.position} (m)")


def left_recordings(task: Task, episodes: Sequence[TensorDict], interval: int, *, beyond: float) -> int:
    """Counts the recorded tool paths that a controller misses by more than ``beyond`` (m, root mean square).

    Compares the steps ``interval`` after each plan in rollouts of :func:`follow_recordings`.
    """
    errors = [of_position(task, tracking_errors(task, [episode], interval)) for episode in episodes]
    return sum(error[-1] > beyond for error in errors if error)


def distance_to_demonstrations(task: Task, episodes: Sequence[TensorDict], data: TensorDictBase) -> dict[str, float]:
    """Measures how far visited and held-out demonstrated states are from the nearest other demonstrated state.

    Every second demonstration is held out, so that neither is compared with itself. Returns 95 % quantiles
    in standard deviations (root mean square over columns); an empty dict for a single demonstration.
    """
    even = data[EPISODE] % 2 == 0
    recorded = data[STATE].double()  # distances are small compared with coordinates
    known, held_out = recorded[even], recorded[~even]
    if not len(held_out):
        return {}
    scale = known.std(0).clamp_min(1e-6) * task.state_dim**0.5
    visited = torch.cat([task.state_of(episode[OBSERVATION]).double() for episode in episodes])
    known, found = known[:: max(1, len(known) // 20000)] / scale, {}
    for name, states in {"visited_95": visited, "demonstrated_95": held_out}.items():
        parts = (states[:: max(1, len(states) // _MOST_STATES)] / scale).split(2048)
        found[name] = torch.cat([torch.cdist(part, known).amin(1) for part in parts]).quantile(0.95).item()
    return found
