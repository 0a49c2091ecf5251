# This source code is licensed under the MIT license found in the LICENSE file.
"""Closed-loop evaluation: one episode per environment, a seed per episode, results independent of the batch size."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_koap.keys import ACTION, COLLISION, MODE, OBSERVATION, SUCCESS
from torchrl_koap.metrics import mode_entropy, wilson_interval
from torchrl_koap.modules.diffusion import SOLVERS
from torchrl_koap.modules.planner import StatePlanner
from torchrl_koap.modules.policies import NOISE, OBSERVATION_HISTORY, EpisodeNoise, PlanThenControl, policy_transforms

OUTCOMES = ("timeout", "success", "collision")


def make_policy(
    planner: StatePlanner,
    controller: TensorDictModuleBase,
    *,
    state_columns: Sequence[int],
    execution: str = "feedback",
    replan_interval: int = 4,
    joining: float = 0.8,
) -> PlanThenControl:
    """Planner and controller as a policy that observes as many frames as the longer-sighted of the two."""
    return PlanThenControl(
        planner,
        controller,
        state_columns=state_columns,
        history=max(planner.history, controller.history + 1),
        execution=execution,
        replan_interval=replan_interval,
        joining=joining,
    )


@torch.no_grad()
def roll_out(
    policy: PlanThenControl,
    make_env: Callable[[int], EnvBase],
    seeds: Sequence[int],
    *,
    max_steps: int,
    batch_size: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[TensorDict]:
    """Runs one episode per seed.

    Args:
        policy (PlanThenControl): the policy.
        make_env (callable): makes an environment of a given number of parallel episodes.
        seeds (sequence of int): one per episode; the planner's noise depends on nothing else.

    Keyword Args:
        max_steps (int): control steps at most.
        batch_size (int, optional): episodes at a time. Default: all. Outcomes do not depend on it.
        progress (callable, optional): called with the number of episodes finished.

    Returns:
        list of TensorDict: one per episode, ``[steps]``, cut at its end.

    Raises:
        ValueError: if there are no seeds, or the batch size is below 1.
    """
    if not len(seeds) or (batch_size is not None and batch_size < 1):
        raise ValueError(f"at least one seed and a batch size >= 1 are needed, got {len(seeds)} and {batch_size}")
    planner = policy.planner
    draws = (1 + planner.num_steps,) if SOLVERS[planner.solver].stochastic else ()
    shape = (*draws, planner.horizon, planner.state_dim)
    size, episodes = batch_size or len(seeds), []
    for begin in range(0, len(seeds), size):
        part = seeds[begin : begin + size]
        env = TransformedEnv(make_env(len(part)), policy_transforms(policy.history))
        noise = EpisodeNoise(part, shape, num_steps=max_steps).to(policy.state_columns.device)
        try:
            rollout = env.rollout(
                max_steps,
                TensorDictSequential(noise, policy),
                break_when_any_done=False,
                break_when_all_done=True,
            )
        finally:
            env.close()
        rollout = rollout.exclude(NOISE, OBSERVATION_HISTORY, ("next", OBSERVATION_HISTORY), "remaining_plan")
        done = rollout["next", "done"].squeeze(-1)
        lengths = torch.where(done.any(-1), done.int().argmax(-1) + 1, done.shape[-1])
        episodes += [rollout[index, :length] for index, length in enumerate(lengths.tolist())]
        if progress is not None:
            progress(len(episodes))
    return episodes


def outcome_of(episode: TensorDict) -> str:
    """``"success"``, ``"collision"`` or ``"timeout"``, from the last frame of an episode."""
    last = episode[-1]["next"]
    if last[SUCCESS].item():
        return "success"
    return "collision" if COLLISION in last.keys() and last[COLLISION].item() else "timeout"


def score(
    episodes: Sequence[TensorDict], seeds: Sequence[int], *, num_modes: int, mode_index: Callable[[Tensor], Tensor]
) -> dict[str, Any]:
    """Success with its 95 % Wilson interval, entropy of the modes of successful episodes, and a row per episode."""
    rows = []
    for seed, episode in zip(seeds, episodes, strict=True):
        mode = int(mode_index(episode[-1]["next", MODE]))
        rows.append({"seed": seed, "outcome": outcome_of(episode), "mode": mode, "steps": len(episode)})
    won = [row for row in rows if row["outcome"] == "success"]
    modes = [row["mode"] for row in won if row["mode"] >= 0]
    low, high = wilson_interval(len(won), len(rows))
    return {
        "episodes": len(rows),
        "success_rate": len(won) / len(rows),
        "success_low": low,
        "success_high": high,
        "mode_entropy": mode_entropy(modes, num_modes),
        "distinct_modes": len(set(modes)),
        "collisions": sum(row["outcome"] == "collision" for row in rows),
        "mean_steps": statistics.fmean(row["steps"] for row in rows),
        "episode": rows,
    }


@torch.no_grad()
def measure_latency(policy: PlanThenControl, observation_dim: int, *, repeats: int = 30) -> dict[str, float]:
    """Median time of a plan and of a control step between plans, at batch 1, in ms, and the control rate in Hz."""
    device = policy.state_columns.device
    observed = torch.zeros(1, policy.history, observation_dim, device=device)
    td = TensorDict({OBSERVATION_HISTORY: observed, "is_init": torch.ones(1, 1, dtype=torch.bool)}, [1], device=device)
    between, with_plan = [], []
    for repeat in range(repeats + 3):
        td["is_init"] = torch.ones(1, 1, dtype=torch.bool, device=device)
        for kind in (with_plan, between):
            _wait(device)
            began = time.perf_counter()
            td = policy(td)
            td[ACTION].sum().item()
            if repeat >= 3:  # the first calls warm caches up
                kind.append((time.perf_counter() - began) * 1e3)
            td["is_init"] = torch.zeros(1, 1, dtype=torch.bool, device=device)
    control = statistics.median(between)
    plan = max(statistics.median(with_plan) - control, 0.0)
    rate = 1e3 / (control + plan / policy.replan_interval)
    return {"plan_ms": plan, "control_ms": control, "control_hz": rate}


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def rollouts_to_tensors(
    episodes: Sequence[TensorDict], *, position: slice, mode_index: Callable[[Tensor], Tensor], interval: int
) -> dict[str, Tensor]:
    """What the pictures need, padded to the longest episode.

    Args:
        episodes (sequence of TensorDict): from :func:`roll_out`.
        position (slice): columns of the observation that are drawn.
        mode_index (callable): mode flags to a number, -1 if incomplete.
        interval (int): steps per plan.

    Returns:
        dict: ``position`` ``[E, T, 2]`` (NaN behind the end), ``length``, ``mode``, ``outcome`` ``[E]``, ``plan``
        ``[E, P, H, 2]`` and ``plan_step`` ``[E, P]`` (NaN and -1 padding; empty for open-loop execution, whose cache
        holds actions).
    """
    longest, last = max(len(episode) for episode in episodes), [episode[-1]["next"] for episode in episodes]
    paths = torch.full((len(episodes), longest + 1, 2), torch.nan)
    plans, plan_steps = [], []
    for index, episode in enumerate(episodes):
        paths[index, : len(episode)] = episode[OBSERVATION][..., position]
        paths[index, len(episode)] = last[index][OBSERVATION][..., position]
        chunks = episode.get("remaining_plan_chunk", None)
        plans.append(torch.zeros(0, 1, 2) if chunks is None else chunks[::interval, 0])
        plan_steps.append(torch.arange(len(plans[-1])) * interval)
    return {
        "position": paths,
        "length": torch.tensor([len(episode) for episode in episodes]),
        "mode": torch.stack([mode_index(end[MODE]).reshape(()) for end in last]).long(),
        "outcome": torch.tensor([OUTCOMES.index(outcome_of(episode)) for episode in episodes]),
        "plan": torch.nn.utils.rnn.pad_sequence(plans, batch_first=True, padding_value=torch.nan),
        "plan_step": torch.nn.utils.rnn.pad_sequence(plan_steps, batch_first=True, padding_value=-1),
    }
