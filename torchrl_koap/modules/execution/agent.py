# This source code is licensed under the MIT license found in the LICENSE file.
"""A policy in a robot's control loop: observation in, action out, everything else kept inside."""

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

KEPT = 10_000  # latencies of the last steps


class FarStateWarning(UserWarning):
    """A state column lies far outside of its demonstrated range."""


def percentiles(seconds: Sequence[float]) -> dict[str, float]:
    """Returns ``p50``, ``p99`` and ``max`` of times of single ``steps`` in ms, and their number."""
    p50, p99, longest = (1e3 * np.percentile(seconds, (50, 99, 100))).tolist()
    return {"p50": p50, "p99": p99, "max": longest, "steps": len(seconds)}


class Agent:
    """Runs a policy in a control loop, for one robot or several at a time, without gradients.

    Frames observed so far, the current plans and start noise live inside. With the same seed the actions are bit for
    bit those of a :class:`~torchrl_koap.modules.PolicyEnv`. Its first episode is that of this seed in ``koap eval``;
    the next ones go on in the same stream.

    Args:
        policy (PlanningPolicy): of :func:`~torchrl_koap.modules.make_policy` or :func:`~torchrl_koap.load_policy`.

    Keyword Args:
        seed (int): seed of the plans' start noise; robot ``i`` of a batch draws with ``seed + i``.

    Warns:
        FarStateWarning: if a state column goes far outside of its demonstrated range, once per column and episode.

    Raises:
        RuntimeError: if it is asked to act before :meth:`reset`.
        TypeError: for anything else than a policy, such as the name of its file.
        ValueError: for a seed that is no whole number >= 0; for observations of another width, batch or number of axes
            than before, that are not finite, or from which no finite action follows.

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
        """Begins an episode with the next observation; random numbers continue."""
        self._forget()
        self._ready = True
        self._episode += 1

    @torch.no_grad()
    def act(self, observation: np.ndarray | Tensor | Sequence[float] | Mapping[str, Any]) -> np.ndarray | Tensor:
        """Returns the action ``[act]`` for an observation ``[obs]`` in raw units, or ``[n, act]`` for several robots.

        It is a tensor where the observation is one, else an array. A policy that was trained with cameras takes
        ``{"state": x, "top": frame}``: numbers ``[d]`` and a frame of every camera by its name, uint8 ``[H, W, 3]``.
        It is float64 where the task has an origin.
        """
        began = time.perf_counter()
        newest = self._checked(observation).unsqueeze(-2)
        if self._frames is None:
            self._frames = newest.expand(-1, self.policy.history, -1).clone()
        else:
            self._frames = torch.cat([self._frames[:, 1:], newest], -2)
        action = self.policy.to_robot(self._decide())
        if not action.isfinite().all():
            self._forget()  # frames and plan hold this observation
            raise ValueError("this observation is so far from the demonstrations that no finite action follows from it")
        action = action[0] if len(self._shape) == 1 else action
        result = action if isinstance(observation, Tensor) else action.cpu().numpy()
        self.latencies.append(time.perf_counter() - began)
        return result

    def latency(self) -> dict[str, float]:
        """Time per action of the last 10,000 steps in ms: ``p50``, ``p99``, ``max``, and the number of ``steps``."""
        if not self.latencies:
            raise RuntimeError("the agent has not acted yet: there is no latency to tell")
        return percentiles(self.latencies)

    def _forget(self) -> None:
        self._carried: TensorDict | None = None  # what the policy wrote in the last step
        self._frames = None
        self._shape: tuple[int, ...] | None = None  # of the observations
        self._far: set[int] = set()  # columns that were warned of

    def _decide(self) -> Tensor:
        """The action for the frames observed by now ``[n, act]``."""
        robots = len(self._frames)
        td = TensorDict(batch_size=[robots], device=self.device) if self._carried is None else self._carried
        td.set(self.policy.in_keys[0], self._frames)
        td.set(IS_INIT, torch.full((robots, 1), self._carried is None, device=self.device))
        if self.policy.planner.noise_key is not None:  # else the planner draws by itself
            td.set(self.policy.planner.noise_key, self._noise(robots))
        td = self.policy(td)
        self._carried = td
        return td.get(self.policy.out_keys[0]).clone()

    def _noise(self, robots: int) -> Tensor:
        """Start noise of a plan ``[n, *noise_shape]``, from a stream per robot."""
        if self._streams is None or len(self._streams) != robots:
            seeds = range(self.seed, self.seed + robots)
            self._streams = NoiseStreams(seeds, self.policy.noise_shape, block=self.policy.max_steps)
        return self._streams.draw().to(self.device, self.dtype)

    def _checked(self, observation: Any) -> Tensor:
        """The observation as ``[n, obs]`` of the policy's type."""
        if not self._ready:
            raise RuntimeError("reset() the agent before the first act(): it has to know where an episode begins")
        if isinstance(observation, Mapping):
            if self.policy.observe is None:
                given = ", ".join(observation)
                raise ValueError(f"this policy was trained without cameras: it takes one vector [obs], got {given}")
            observation = self.policy.observe(observation)
        observed = observed_numbers(observation)
        if observed.is_complex() or observed.is_meta or observed.layout != torch.strided:
            raise ValueError(f"an observation must be plain numbers, got a tensor of {observed.dtype}")
        shape = tuple(observed.shape)
        if len(shape) not in (1, 2) or not observed.numel():
            raise ValueError(f"an observation must be [obs] or [n, obs], got {list(shape)}")
        if self._shape is not None and shape != self._shape:
            raise ValueError(
                f"the observation is {list(shape)}, those before were {list(self._shape)}; reset() the agent for"
                " another robot or batch"
            )
        read = self.policy.from_robot(observed).to(self.device, self.dtype).reshape(-1, shape[-1])
        bad = ~read.isfinite()
        if bad.any():
            columns = bad.any(0).nonzero().flatten().tolist()
            raise ValueError(f"columns {columns} of the observation are NaN or infinite as {self.dtype}")
        state = self.policy.state_of(read)  # refuses another width before anything is kept
        planner = self.policy.planner
        far = set()
        if isinstance(planner, ConditionalSampler):
            far = {*planner.far(state).any(0).nonzero().flatten().tolist()} - self._far
        if far:
            self._far |= far
            warnings.warn(  # with the episode's number, as Python shows a repeated text once only
                f"in episode {self._episode} columns {sorted(far)} of the state lie beyond the demonstrated range by"
                " more than that range: another unit or robot, a faulty sensor, or a quaternion of the other sign?",
                FarStateWarning,
                stacklevel=4,
            )
        self._shape = shape
        return read
