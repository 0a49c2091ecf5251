# This source code is licensed under the MIT license found in the LICENSE file.
"""Measures the time of a policy per control step, and the late steps of a control loop."""

from __future__ import annotations

import statistics
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_koap.evaluation.rollouts import device_of
from torchrl_koap.keys import ACTION
from torchrl_koap.modules import Agent, AsynchronousAgent, PlanningPolicy
from torchrl_koap.modules.execution.agent import FarStateWarning, percentiles
from torchrl_koap.runs.device import set_up_torch, torch_as_before
from torchrl_koap.runs.plugins import Plugins
from torchrl_koap.training.trained import Trained
from torchrl_koap.vision import Observer

_REPEATS = 30  # timed steps with a plan, and without; their medians are reported


@dataclass
class LatencyConfig:
    """A control loop in real time with a trained policy, on made-up observations.

    Attributes:
        steps: control steps.
        control_hz: steps per second (default: that of the task).
        async_replan: make the next plan in a thread while the present one is executed.
        threads: torch threads.
        plugins: modules that register tasks, methods or pictures, besides those that the run was trained with.
    """

    steps: int = 300
    control_hz: float | None = None
    async_replan: bool = False
    threads: int = 1
    plugins: Plugins = ()


@torch.no_grad()
def measure_latency(policy: PlanningPolicy, observation_dim: int) -> dict[str, float]:
    """Measures median times of a plan and of a control step between plans, at batch size 1, after three warm-up calls.

    Returns ``plan_ms``, which a plan adds to a step, ``control_ms`` of a step without a plan, and ``control_hz``: the
    mean rate of control (Hz) if a plan is made every ``replan_interval`` steps.
    """
    device = device_of(policy)
    td = TensorDict({policy.in_keys[0]: torch.zeros(1, policy.history, observation_dim)}, [1], device=device)
    took: dict[bool, list[float]] = {True: [], False: []}  # with a plan, and without
    for _ in range(_REPEATS + 3):
        for begins, times in took.items():
            td["is_init"] = torch.full((1, 1), begins, device=device)
            began = time.perf_counter()
            td = policy(td)
            td[ACTION].sum().item()  # waits for a GPU
            times.append((time.perf_counter() - began) * 1e3)
    with_plan, control = (statistics.median(times[3:]) for times in took.values())
    plan = max(with_plan - control, 0.0)
    rate = 1e3 / (control + plan / policy.execution.replan_interval)
    return {"plan_ms": plan, "control_ms": control, "control_hz": rate}


@torch_as_before()
def measure_control_loop(run: str | Path, config: LatencyConfig) -> dict[str, Any]:
    """Runs :func:`run_control_loop` with a trained policy; ``koap latency`` calls this."""
    if config.steps < 1:
        raise ValueError(f"steps must be >= 1, got {config.steps}")
    set_up_torch(config.threads, "cpu")
    trained = Trained.load(run, plugins=config.plugins)
    rate = trained.task.control_hz if config.control_hz is None else config.control_hz
    policy = trained.policy()
    observations = 0.01 * np.random.default_rng(0).standard_normal((config.steps, trained.task.observation_dim))
    if trained.cameras:
        observations = [Observer(trained.task, trained.cameras).example()] * config.steps
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FarStateWarning)  # made-up observations
        if not config.async_replan:
            policy.check_rate(rate)
            return run_control_loop(Agent(policy), observations, control_hz=rate)
        with AsynchronousAgent(policy, control_hz=rate) as agent:
            return run_control_loop(agent, observations, control_hz=rate)


def run_control_loop(agent: Agent, observations: Sequence[Any] | np.ndarray, *, control_hz: float) -> dict[str, Any]:
    """Gives an agent one observation per control period and counts the actions that take longer than a period.

    Returns ``steps``, ``late_steps``, ``step_ms`` (the period), and ``p50``, ``p99`` and ``max`` of the time from an
    observation to its action (ms).
    """
    agent.reset(observations[0]) if isinstance(agent, AsynchronousAgent) else agent.reset()
    period, took = 1 / control_hz, []
    tick = time.perf_counter()
    for observation in observations:
        agent.act(observation)
        took.append(time.perf_counter() - tick)
        tick += period
        pause = tick - time.perf_counter()
        if pause > 0:
            time.sleep(pause)
        else:  # a late step shifts the clock and does not make the next one late
            tick = time.perf_counter()
    late = sum(seconds > period for seconds in took)
    return {"late_steps": late, "step_ms": 1e3 * period, **percentiles(took)}
