# This source code is licensed under the MIT license found in the LICENSE file.
"""Runs a policy in a robot's control loop: it takes observations, returns actions and stores all other state."""

from __future__ import annotations

import time
import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_koap.keys import observed_numbers
from torchrl_koap.modules.execution.policy import IS_INIT, PlanningPolicy
from torchrl_koap.modules.execution.policy_env import NoiseStreams
from torchrl_koap.modules.planning.sampler import ConditionalSampler

KEPT = 10_000  # steps whose latencies are stored


class FarStateWarning(UserWarning):
    """A state column lies far outside its demonstrated range."""


def percentiles(seconds: Sequence[float]) -> dict[str, float]:
    """Returns ``p50``, ``p99`` and ``max`` of step times (given in seconds) in ms, and the number of ``steps``."""
    p50, p99, longest = (1e3 * np.percentile(seconds, (50, 99, 100))).tolist()
    return {"p50": p50, "p99": p99, "max": longest, "steps": len(seconds)}


class Agent:
    """Runs a policy in a control loop, for one robot or several at a time, without gradients.

    The agent stores the observed frames, the current plans and the start noise. With the same seed its actions equal
    those of a :class:`~torchrl_koap.modules.PolicyEnv` bit for bit. Its first episode equals that of this seed in
    ``koap eval``; later episodes continue the same random stream.

    Args:
        policy (PlanningPolicy): from :func:`~torchrl_koap.modules.make_policy` or :func:`~torchrl_koap.load_policy`.

    Keyword Args:
        seed (int): seed of the plans' start noise; robot ``i`` of a batch uses ``seed + i``.

    Warns:
        FarStateWarning: once per column and episode, if a state exceeds its demonstrated range by that range's width.

    Raises:
        RuntimeError: if :meth:`act` is called before :meth:`reset`.
        TypeError: if ``policy`` is not a policy, for example a file name.
        ValueError: if the seed is not an integer >= 0, if an observation is not finite or differs from earlier ones in
            width, batch size or number of axes, or if the resulting action is not finite.

    Examples:
        >>> import numpy as np
        >>> from torchrl_koap.modules import Agent, StatePlanner, TemporalUnet, make_policy
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> policy = make_policy(planner, make_koopman_inverse_dynamics(2, 3), state_of=(2, 3))
        >>> agent = Agent(policy, seed=0)
        >>> agent.reset()
        >>> agent.act(np.zeros(4)).shape, agent.act(np.zeros(4)).shape
        ((3,), (3,))
    """

    _frames: Tensor | None  # [n, history, obs]

    def __init__(self, policy: PlanningPolicy, *, seed: int = 0):
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ValueError(f"seed must be a whole number >= 0, got {seed!r}")
        if not isinstance(policy, torch.nn.Module):  # a compiled policy is one too
            raise TypeError(f"policy must come from load_policy() or Trained.policy(), got {type(policy).__name__}")
        self.policy, self.seed = policy, int(seed)
        example = next(policy.parameters(), torch.empty(0))
        self.device, self.dtype = example.device, example.dtype
        self.latencies: deque[float] = deque(maxlen=KEPT)
        self._streams: NoiseStreams | None = None
        self._ready, self._episode = False, 0
        self._forget()

    def reset(self) -> None:
        """Begins an episode with the next observation; the stream of random numbers continues."""
        self._forget()
        self._ready = True
        self._episode += 1

    @torch.no_grad()
    def act(self, observation: np.ndarray | Tensor | Sequence[float] | Mapping[str, Any]) -> np.ndarray | Tensor:
        """Returns the action ``[act]`` for an observation ``[obs]`` in raw units, or ``[n, act]`` for several robots.

        The action is a tensor if the observation is a tensor, else an array; it is float64 if the task has an origin.
        A policy that was trained with cameras takes ``{"state": x, "top": frame}``: numbers ``[d]``, and one frame,
        uint8 ``[H, W, 3]``, under the name of each camera.
        """
        began = time.perf_counter()
        newest = self._checked(observation).unsqueeze(-2)
        if self._frames is None:
            self._frames = newest.expand(-1, self.policy.history, -1).clone()
        else:
            self._frames = torch.cat([self._frames[:, 1:], newest], -2)
        action = self.policy.to_robot(self._decide())
        if not action.isfinite().all():
            self._forget()  # the stored frames and plan depend on this observation
            raise ValueError("the action is not finite: this observation is too far from the demonstrations")
        action = action[0] if len(self._shape) == 1 else action
        result = action if isinstance(observation, Tensor) else action.cpu().numpy()
        self.latencies.append(time.perf_counter() - began)
        return result

    def latency(self) -> dict[str, float]:
        """Returns the time per action in ms over the last 10,000 steps (:func:`percentiles`)."""
        if not self.latencies:
            raise RuntimeError("no latency has been measured: call act() first")
        return percentiles(self.latencies)

    def _forget(self) -> None:
        self._carried: TensorDict | None = None  # tensordict that the policy wrote in the last step
        self._frames = None
        self._shape: tuple[int, ...] | None = None  # shape of the observations
        self._far: set[int] = set()  # columns that a warning has named

    def _decide(self) -> Tensor:
        """Returns the action ``[n, act]`` for the frames observed so far."""
        robots = len(self._frames)
        td = TensorDict(batch_size=[robots], device=self.device) if self._carried is None else self._carried
        td.set(self.policy.in_keys[0], self._frames)
        td.set(IS_INIT, torch.full((robots, 1), self._carried is None, device=self.device))
        if self.policy.planner.noise_key is not None:  # with None the planner draws its own noise
            td.set(self.policy.planner.noise_key, self._noise(robots))
        td = self.policy(td)
        self._carried = td
        return td.get(self.policy.out_keys[0]).clone()

    def _noise(self, robots: int) -> Tensor:
        """Draws the start noise ``[n, *noise_shape]`` of a plan, from one stream per robot."""
        if self._streams is None or len(self._streams) != robots:
            seeds = range(self.seed, self.seed + robots)
            self._streams = NoiseStreams(seeds, self.policy.noise_shape, block=self.policy.max_steps)
        return self._streams.draw().to(self.device, self.dtype)

    def _checked(self, observation: Any) -> Tensor:
        """Checks an observation and returns it as ``[n, obs]`` in the policy's dtype."""
        if not self._ready:
            raise RuntimeError("reset() the agent before the first act(): reset() begins an episode")
        if isinstance(observation, Mapping):
            if self.policy.observe is None:
                given = ", ".join(observation)
                raise ValueError(f"this policy was trained without cameras: it takes one vector [obs], got {given}")
            observation = self.policy.observe(observation)
        observed = observed_numbers(observation)
        shape = tuple(observed.shape)
        if len(shape) not in (1, 2) or not observed.numel():
            raise ValueError(f"an observation must be [obs] or [n, obs], got {list(shape)}")
        if self._shape is not None and shape != self._shape:
            raise ValueError(
                f"the observation has shape {list(shape)}, earlier ones had {list(self._shape)}; reset() the agent for"
                " another robot or batch"
            )
        read = self.policy.from_robot(observed).to(self.device, self.dtype).reshape(-1, shape[-1])
        bad = ~read.isfinite()
        if bad.any():
            columns = bad.any(0).nonzero().flatten().tolist()
            raise ValueError(f"columns {columns} of the observation are NaN or infinite as {self.dtype}")
        state = self.policy.state_of(read)  # raises for a wrong width, before the agent stores anything
        planner = self.policy.planner
        far = set()
        if isinstance(planner, ConditionalSampler):
            far = {*planner.far(state).any(0).nonzero().flatten().tolist()} - self._far
        if far:
            self._far |= far
            warnings.warn(  # the episode number makes the texts differ: Python shows a repeated text only once
                f"in episode {self._episode} columns {sorted(far)} of the state lie beyond the demonstrated range by"
                " more than that range: another unit or robot, a faulty sensor, or a quaternion of the other sign?",
                FarStateWarning,
                stacklevel=4,
            )
        self._shape = shape
        return read
