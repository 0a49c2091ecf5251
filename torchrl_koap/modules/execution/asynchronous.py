# This source code is licensed under the MIT license found in the LICENSE file.
"""Control that never waits for a plan: the next one is made in a thread while the present one is executed."""

from __future__ import annotations

import math
import time
from concurrent.futures import Future, ThreadPoolExecutor

import torch
from torch import Tensor

from torchrl_koap.modules.execution.agent import Agent
from torchrl_koap.modules.execution.plan_then_control import PlanThenControl


class AsynchronousAgent(Agent):
    """Acts with a plan while the next one is made; what is executed meanwhile binds the new plan.

    ::

        step                 0     1     2     3     4     5     6     7
        plan in force        P     P     P     P     P     P     P'    P'
        in the thread                                P'---------        P''---
        first states of P'                           P_4 = P'_1, P_5 = P'_2: executed before P' is there

    Real-time chunking (arXiv 2506.07339) with the hard constraint: at every solver step the states that will have been
    executed when the plan is ready take the place of the planner's own. How many these are is taken from the time that
    the last plan took. Actions are decoded at every step from the history observed by then, as in ``"feedback"``.

    The first plan of an episode has no predecessor: hand the first observation to :meth:`reset`, which makes it before
    the clock runs.

    Args:
        policy (PlanThenControl): a policy that decodes at every step.

    Keyword Args:
        control_hz (float): control steps per second, by which a plan's time becomes a number of steps.
        seed (int): as for :class:`Agent`.

    Raises:
        ValueError: for another kind of policy, open-loop execution, several candidates, or a rate that is not
            positive.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.modules import AsynchronousAgent, PlanThenControl, StatePlanner, TemporalUnet
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> policy = PlanThenControl(
        ...     StatePlanner(TemporalUnet(2, 4), state_dim=2), make_koopman_inverse_dynamics(2, 3),
        ...     state_columns=(2, 3), history=5)
        >>> with AsynchronousAgent(policy, control_hz=30.0) as agent:
        ...     agent.reset(np.zeros(4))
        ...     agent.act(np.zeros(4)).shape
        (3,)
    """

    _plan: Tensor | None  # [n, H, d], in force

    def __init__(self, policy: PlanThenControl, *, control_hz: float, seed: int = 0):
        if not isinstance(policy, PlanThenControl) or policy.execution != "feedback":
            raise ValueError("plans are made asynchronously for a PlanThenControl with execution 'feedback' only")
        if policy.candidates != 1:
            raise ValueError(f"plans are made asynchronously one at a time, not of {policy.candidates} candidates")
        if not (math.isfinite(control_hz) and control_hz > 0):
            raise ValueError(f"control_hz must be a positive number of steps per second, got {control_hz}")
        self.control_hz = control_hz
        self._delay = 1  # steps that a plan takes
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="planner")
        self._pending: Future[tuple[Tensor, float]] | None = None
        super().__init__(policy, seed=seed)

    def __enter__(self) -> AsynchronousAgent:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Waits for the plan that is being made, and ends the thread."""
        self._thread.shutdown(wait=True)

    def reset(self, observation: object = None) -> None:
        """Forgets everything: the next observation begins an episode.

        Args:
            observation (array or Tensor, optional): the first observation, ``[obs]`` or ``[n, obs]``: the first plan is
                made from it now. Default: it is made in the first :meth:`act`, which waits for it.
        """
        super().reset()
        if observation is not None:
            frames = self._checked(observation).unsqueeze(-2).expand(-1, self.policy.history, -1)
            self._plan, took = self._make(self.policy.state_of(frames), self._noise_for(len(frames)), None)
            self._delay = self._steps(took)

    def _forget(self) -> None:
        super()._forget()
        if self._pending is not None:
            self._pending.result()
        self._pending = None
        self._plan = None
        self._age = 0  # steps since the plan was begun
        self._begun = 0  # steps since the pending one was begun

    @torch.no_grad()
    def _decide(self) -> Tensor:
        history = self.policy.state_of(self._frames)
        if self._plan is None:
            self._plan, took = self._make(history, self._noise_for(len(history)), None)
            self._delay = self._steps(took)
        if self._pending is not None and self._pending.done():
            self._plan, took = self._pending.result()
            self._delay, self._age, self._pending = self._steps(took), self._begun, None
        if self._pending is None and self._age >= self.policy.replan_interval:
            bound = self._remaining()[..., : min(self._delay, self.policy.planner.horizon - 1), :]
            self._pending = self._thread.submit(self._make, history, self._noise_for(len(history)), bound)
            self._begun = 0
        action = self.policy.scaled(self.policy.decide(self._frames, history, self._remaining()))
        self._age += 1
        self._begun += 1
        return action if self.policy.leash is None else self.policy.leash.hold(self._frames, action)

    def _remaining(self) -> Tensor:
        """What is left of the plan in force, its last state repeated."""
        steps = torch.arange(self._plan.shape[-2], device=self._plan.device) + self._age
        return self._plan[..., steps.clamp_max(self._plan.shape[-2] - 1), :]

    @torch.no_grad()
    def _make(self, history: Tensor, noise: Tensor, known: Tensor | None) -> tuple[Tensor, float]:
        began = time.perf_counter()
        planner = self.policy.planner
        plan = planner.sample(history[..., -planner.history :, :], noise, prefix=known)
        return plan, time.perf_counter() - began

    def _steps(self, seconds: float) -> int:
        return max(math.ceil(seconds * self.control_hz), 1)
