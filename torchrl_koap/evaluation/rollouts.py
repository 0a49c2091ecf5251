# This source code is licensed under the MIT license found in the LICENSE file.
"""Closed-loop evaluation: one episode per environment, a seed per episode, noise independent of the batch size."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_koap.evaluation.scores import outcome_of
from torchrl_koap.evaluation.statistics import OUTCOMES
from torchrl_koap.keys import ACTION, CONTEXT, MODE, OBSERVATION, PLAN
from torchrl_koap.modules import PlanningPolicy, policy_transforms
from torchrl_koap.modules.execution.policy_env import NOISE, NoiseStreams
from torchrl_koap.tasks import Task

SHOWN = 6  # most state columns that are drawn for a task without an environment
AT_ONCE = 500  # default number of parallel episodes


@runtime_checkable
class EpisodeSeeds(Protocol):
    """An environment or a transform that draws random numbers per episode."""

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Seeds every parallel episode, so that none depends on the others."""


@torch.no_grad()
def roll_out(
    policy: PlanningPolicy,
    make_env: Callable[[int], EnvBase],
    seeds: Sequence[int],
    *,
    max_steps: int,
    batch_size: int | None = None,
    contexts: Any = None,
    given: Callable[[slice], TensorDictModuleBase] | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[TensorDict]:
    """Runs one episode per seed, which alone determines the planner's noise; returns each ``[steps]``, cut at its end.

    ``make_env`` makes an environment with a given number of parallel episodes, ``batch_size`` (:data:`AT_ONCE` by
    default). Actions depend on it only by rounding errors, which contacts amplify. ``contexts`` holds the context
    ``[objects, 3]`` of every episode. ``given(episodes)`` returns a module that writes the planner's input in place of
    noise. ``progress`` is called with the number of episodes finished.

    Raises:
        ValueError: for another number of contexts than of seeds.
    """
    if contexts is not None and len(contexts) != len(seeds):
        raise ValueError(f"one context per seed is needed, got {len(contexts)} and {len(seeds)}")
    noise_key, episodes = policy.planner.noise_key or NOISE, []
    size = batch_size or min(len(seeds), AT_ONCE)
    for begin in range(0, len(seeds), size):
        part = seeds[begin : begin + size]
        env = make_env(len(part))
        env.set_seed(part[0])  # for the environment's own random numbers
        for module in env.modules():  # transforms, and the environment itself
            if isinstance(module, EpisodeSeeds):
                module.seed_episodes(part)
        transforms = policy_transforms(policy.history, history_key=policy.in_keys[0])
        env = env.append_transform(transforms) if isinstance(env, TransformedEnv) else TransformedEnv(env, transforms)
        env = env.to("cpu")  # so that it moves actions to the CPU
        if given is not None:
            noise = given(slice(begin, begin + len(part)))
        else:
            streams = NoiseStreams(part, policy.noise_shape, block=policy.max_steps)
            noise = TensorDictModule(streams.draw, in_keys=[], out_keys=[noise_key])
        policy.attach(env)
        start = {} if contexts is None else {"contexts": contexts[begin : begin + size]}
        try:
            rollout = env.rollout(
                max_steps,
                TensorDictSequential(noise, policy),
                auto_cast_to_device=True,
                auto_reset=False,
                tensordict=env.reset(**start),
                break_when_any_done=False,
                break_when_all_done=True,
            )
        finally:
            env.close()
        rollout = rollout.exclude(noise_key, policy.in_keys[0], ("next", policy.in_keys[0]))
        done = rollout["next", "done"].squeeze(-1)
        lengths = torch.where(done.any(-1), done.int().argmax(-1) + 1, done.shape[-1])
        episodes += [rollout[index, :length] for index, length in enumerate(lengths.tolist())]
        if progress is not None:
            progress(len(episodes))
    return episodes


def device_of(module: nn.Module) -> torch.device:
    """Returns the device of a module's parameters and buffers, the CPU if it has none."""
    return next(itertools.chain(module.parameters(), module.buffers()), torch.empty(0)).device


def observations_of(episode: TensorDict) -> Tensor:
    """Returns the observations of an episode ``[T]`` and, unless an error ended it, the one after its last step."""
    frames = torch.cat([episode[OBSERVATION], episode[-1:]["next", OBSERVATION]])  # [T + 1, obs]
    return frames[:-1] if outcome_of(episode) == "error" else frames


def rollouts_to_tensors(episodes: Sequence[TensorDict], task: Task, *, interval: int) -> dict[str, Tensor]:
    """Stacks the tensors that the report draws, padded to the longest episode.

    A plan was made every ``interval`` steps. For a task without an environment, keeps the columns that actions move.

    Returns:
        dict: ``position`` ``[E, T, 2]`` (NaN after the end), ``length``, ``mode``, ``outcome`` ``[E]``, ``action``
        ``[E, T, act]``, ``plan`` ``[E, P, H, 2]`` and ``plan_step`` ``[E, P]`` (NaN and -1 padding; empty for open-loop
        execution, whose cache holds actions); where episodes have a context ``object_position`` ``[E, T, objects, 2]``
        and ``context`` ``[E, objects, 3]``; without an environment ``column`` ``[k]``, ``state`` ``[E, T, k]`` and
        ``state_plan`` ``[E, P, H, k]``, NaN after the end.
    """
    pad, last = partial(pad_sequence, batch_first=True), [episode[-1]["next"] for episode in episodes]
    frames = [observations_of(episode) for episode in episodes]
    bodies = task.bodies if CONTEXT in last[0].keys() else ()  # other environments than the task's do not report bodies
    starts = [task.observation[part].start for part in (task.position, *(body.position for body in bodies))]
    columns = [slice(start, start + 2) for start in starts]
    paths = [torch.stack([seen[:, part] for part in columns], 1).float() for seen in frames]
    path = pad(paths, padding_value=torch.nan)
    none = torch.zeros(0, 1, max(2, task.state_dim))
    made = [episode.get(PLAN, none)[::interval] for episode in episodes]
    plans = [plan[..., :2] if task.plans_position else none[..., :2] for plan in made]
    tensors = {
        "position": path[:, :, 0].contiguous(),
        "length": torch.tensor([len(episode) for episode in episodes]),
        "mode": torch.stack([task.modes.index_of(end[MODE]) for end in last]),
        "outcome": torch.tensor([OUTCOMES.index(outcome_of(episode)) for episode in episodes]),
        "plan": pad(plans, padding_value=torch.nan),
        "action": pad([episode[ACTION] for episode in episodes], padding_value=torch.nan),
    }
    if task.env is None:
        about = tuple(task.targets.values()) or task.moved_columns() or task.robot or range(task.state_dim)
        chosen, plans = list(about[:SHOWN]), made
        tensors["column"] = torch.tensor(chosen)
        tensors["state"] = pad([task.state_of(seen)[:, chosen] for seen in frames], padding_value=torch.nan)
        tensors["state_plan"] = pad([plan[..., chosen] for plan in made], padding_value=torch.nan)
    tensors["plan_step"] = pad([torch.arange(len(plan)) * interval for plan in plans], padding_value=-1)
    if bodies:
        tensors["object_position"] = path[:, :, 1:].contiguous()
        tensors["context"] = torch.stack([end[CONTEXT] for end in last])
    return tensors
