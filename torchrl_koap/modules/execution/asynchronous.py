# This source code is licensed under the MIT license found in the LICENSE file.
"""Asynchronous planning: a thread makes the next plan while the present one is executed."""

from __future__ import annotations

import math
import time
import warnings
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

import torch
from torch import Tensor

from torchrl_koap.modules.execution.agent import Agent
from torchrl_koap.modules.execution.followers import remaining_plan
from torchrl_koap.modules.execution.policy import PlanningPolicy


class AsynchronousAgent(Agent):
    """Agent that follows a plan while a thread makes the next one.

    ::

        step                 0     1     2     3     4     5     6     7
        current plan         P     P     P     P     P     P     P'    P'
        in the thread                                P'---------        P''---
        first states of P'                           P_4 = P'_1, P_5 = P'_2: executed before P' is there

    Real-time chunking (arXiv 2506.07339) with the hard constraint: at every solver step the states that will have been
    executed when the plan is ready take the place of the planner's own, as many as the time of the last plan says.
    Actions are decoded at every step from the history observed by then, as in ``"feedback"``.

    The first plan of an episode has no predecessor: hand the first observation to :meth:`reset`, which makes it before
    the clock runs.

    Args:
        policy (PlanningPolicy): one that follows plans with strategy ``"feedback"``.

    Keyword Args:
        control_hz (float): control steps per second, by which a plan's time becomes a number of steps. One that differs
            from that of the policy by more than a fifth is warned of.
        seed (int): as for :class:`Agent`.

    Warns:
        UserWarning: as :class:`Agent`, and if a plan ends before the next one is there, once per episode.

    Raises:
        RuntimeError: if it is asked to act or :meth:`reset` after :meth:`close`.
        TypeError: for anything else than a policy, such as the name of its file.
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
            raise ValueError(
                f"plans are made asynchronously with strategy 'feedback', not {policy.execution.strategy!r}"
            )
        policy.check_rate(control_hz)
        self.control_hz = control_hz
        self._delay = 1  # steps that a plan takes
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planner")

    def __enter__(self) -> AsynchronousAgent:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Waits for the plan in progress, and ends the thread: the agent acts no more."""
        self._closed = True
        self._thread.shutdown(wait=True)

    def reset(self, observation: object = None) -> None:
        """Begins an episode with the next observation.

        From the first observation, ``[obs]`` or ``[n, obs]``, the first plan is made now; without one it is made in the
        first :meth:`act`, which waits for it.
        """
        self._refuse_closed()
        super().reset()
        if observation is not None:
            self._make_first(self._checked(observation).unsqueeze(-2).expand(-1, self.policy.history, -1))

    def _checked(self, observation: Any) -> Tensor:
        self._refuse_closed()
        return super()._checked(observation)

    def _refuse_closed(self) -> None:
        if self._closed:
            raise RuntimeError("the agent was closed: make a new one")

    def _forget(self) -> None:
        super()._forget()
        if self._pending is not None:
            wait([self._pending])  # of another episode, as is an error in it
        self._pending = None
        self._plan = None
        self._told = False  # that a plan ended
        self._age = 0  # steps since the plan was begun
        self._begun = 0  # steps since the pending one was begun

    @torch.no_grad()
    def _decide(self) -> Tensor:
        frames, policy = self._frames, self.policy
        if self._plan is None:
            self._make_first(frames)
        if self._pending is not None and self._pending.done():
            made, self._pending = self._pending, None
            self._plan, took = made.result()
            self._delay, self._age = self._steps(took), self._begun
        if self._pending is None and self._age >= policy.execution.replan_interval:
            bound = remaining_plan(self._plan, self._age)[..., : min(self._delay, policy.planner.horizon - 1), :]
            self._pending = self._thread.submit(self._make, frames, self._noise(len(frames)), bound)
            self._begun = 0
        if self._age >= policy.planner.horizon and not self._told:
            self._told = True
            seconds = (policy.planner.horizon - policy.execution.replan_interval) / self.control_hz
            warnings.warn(
                f"in episode {self._episode} a plan ended before the next one was there: until then its last state is"
                f" followed. At {self.control_hz:g} Hz a plan may take {1e3 * seconds:.0f} ms; torch.set_num_threads(1)"
                " may help. In a process forked after the agent was made no plan ever comes",
                stacklevel=5,
            )
        action = policy.act(frames, self._plan, self._age)
        self._age += 1
        self._begun += 1
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
