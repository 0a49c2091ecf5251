# This source code is licensed under the MIT license found in the LICENSE file.
"""Asynchronous planning: a thread makes the next plan while the current one is executed."""

from __future__ import annotations

import math
import time
import warnings
from concurrent.futures import Future, ThreadPoolExecutor, wait

import torch
from torch import Tensor

from torchrl_koap.modules.execution.agent import Agent
from torchrl_koap.modules.execution.followers import remaining_plan
from torchrl_koap.modules.execution.policy import PlanningPolicy


class AsynchronousAgent(Agent):
    """Follows a plan while a thread makes the next one.

    ::

        step                 0     1     2     3     4     5     6     7
        current plan         P     P     P     P     P     P     P'    P'
        in the thread                                P'---------        P''---
        first states of P'                           P_4 = P'_1, P_5 = P'_2: executed before P' is ready

    This is real-time chunking (arXiv 2506.07339) with the hard constraint. Some states of the current plan will be
    executed before the next plan is ready; at every solver step they replace the first states of the next plan. Their
    number follows from the time that the last plan took. Actions are decoded at every step from the history observed
    so far, as in ``"feedback"``.

    The first plan of an episode has no predecessor. Pass the first observation to :meth:`reset`, which makes this plan
    before control begins.

    Args:
        policy (PlanningPolicy): follows plans with strategy ``"feedback"``; its planner samples with a ``prefix``.

    Keyword Args:
        control_hz (float): control steps per second; converts planning time to steps.
        seed (int): as for :class:`Agent`.

    Warns:
        UserWarning: as :class:`Agent`; if ``control_hz`` is outside 0.8 to 1.25 times the policy's rate; and if a plan
            ends before the next one is ready, once per episode.

    Raises:
        RuntimeError: if :meth:`act` or :meth:`reset` is called after :meth:`close`.
        TypeError: if ``policy`` is not a policy, for example a file name.
        ValueError: for another strategy, or a rate that is not positive.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.modules import AsynchronousAgent, StatePlanner, TemporalUnet, make_policy
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> policy = make_policy(planner, make_koopman_inverse_dynamics(2, 3), state_of=(2, 3))
        >>> with AsynchronousAgent(policy, control_hz=30.0) as agent:
        ...     agent.reset(np.zeros(4))
        ...     agent.act(np.zeros(4)).shape
        (3,)
    """

    _plan: Tensor | None  # [n, H, d], the current one
    _pending: Future[tuple[Tensor, float]] | None = None
    _closed = False

    def __init__(self, policy: PlanningPolicy, *, control_hz: float, seed: int = 0):
        super().__init__(policy, seed=seed)
        if policy.execution.strategy != "feedback":
            raise ValueError(f"asynchronous planning needs strategy 'feedback', got {policy.execution.strategy!r}")
        policy.check_rate(control_hz)
        self.control_hz = control_hz
        self._delay = 1  # steps that a plan takes
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planner")

    def __enter__(self) -> AsynchronousAgent:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Waits for the plan in progress and ends the thread; the agent cannot act afterwards."""
        self._closed = True
        self._thread.shutdown(wait=True)

    @torch.no_grad()
    def reset(self, observation: object = None) -> None:
        """Begins an episode with the next observation.

        If the first observation, ``[obs]`` or ``[n, obs]``, is given, the first plan is made here. Otherwise the first
        :meth:`act` makes it and waits for it.
        """
        self._refuse_closed()
        super().reset()
        if observation is not None:
            self._make_first(self._checked(observation).unsqueeze(-2).expand(-1, self.policy.history, -1))

    def _refuse_closed(self) -> None:
        if self._closed:
            raise RuntimeError("the agent was closed: make a new one")

    def _forget(self) -> None:
        super()._forget()
        if self._pending is not None:
            wait([self._pending])  # this plan, or its error, belongs to an earlier episode
        self._pending = None
        self._plan = None
        self._warned = False  # whether this episode has a warning that a plan ended
        self._age = 0  # steps since planning of the current plan began
        self._pending_age = 0  # steps since planning of the pending one began

    @torch.no_grad()
    def _decide(self) -> Tensor:
        self._refuse_closed()
        frames, policy = self._frames, self.policy
        if self._plan is None:
            self._make_first(frames)
        if self._pending is not None and self._pending.done():
            made, self._pending = self._pending, None
            self._plan, took = made.result()
            self._delay, self._age = self._steps(took), self._pending_age
        if self._pending is None and self._age >= policy.execution.replan_interval:
            bound = remaining_plan(self._plan, self._age)[..., : min(self._delay, policy.planner.horizon - 1), :]
            self._pending = self._thread.submit(self._make, frames, self._noise(len(frames)), bound)
            self._pending_age = 0
        if self._age >= policy.planner.horizon and not self._warned:
            self._warned = True
            seconds = (policy.planner.horizon - policy.execution.replan_interval) / self.control_hz
            warnings.warn(
                f"in episode {self._episode} a plan ended before the next one was ready; the agent follows its last"
                f" state until then. At {self.control_hz:g} Hz planning may take at most {1e3 * seconds:.0f} ms;"
                " torch.set_num_threads(1) may help. Make the agent after forking a process, or its thread is missing",
                stacklevel=5,
            )
        action = policy.act(frames, self._plan, self._age)
        self._age += 1
        self._pending_age += 1
        return action

    def _make_first(self, frames: Tensor) -> None:
        self._plan, took = self._make(frames, self._noise(len(frames)), None)
        self._delay = self._steps(took)

    @torch.no_grad()
    def _make(self, frames: Tensor, noise: Tensor, prefix: Tensor | None) -> tuple[Tensor, float]:
        began = time.perf_counter()
        plan = self.policy.sample(self.policy.state_of(frames), noise, prefix=prefix)
        return plan, time.perf_counter() - began

    def _steps(self, seconds: float) -> int:
        return max(math.ceil(seconds * self.control_hz), 1)
