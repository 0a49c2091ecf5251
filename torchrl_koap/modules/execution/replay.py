# This source code is licensed under the MIT license found in the LICENSE file.
"""Recorded and seeded inputs of a policy: noise of an episode's own, and recorded futures in place of plans."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_koap.modules.planning.planner import StatePlanner

NOISE = "noise"
RECORDED_FUTURE = "recorded_future"


class EpisodeNoise(TensorDictModuleBase):
    """Start noise of the planner that depends on an episode's seed and step alone, not on the batch it runs in.

    Args:
        seeds (sequence of int): one per environment.
        shape (sequence of int): shape of one draw, ``[H, d]``.

    Keyword Args:
        num_steps (int): control steps to draw for.
        noise_key (NestedKey): entry that is written, ``planner.noise_key``. Defaults to ``"noise"``.

    Raises:
        RuntimeError: at the call, when all draws are used up.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import EpisodeNoise
        >>> noise = EpisodeNoise([7, 8], (14, 2), num_steps=3)
        >>> first = noise(TensorDict(batch_size=[2]))["noise"]
        >>> bool((EpisodeNoise([8], (14, 2), num_steps=3)(TensorDict(batch_size=[1]))["noise"] == first[1]).all())
        True
    """

    def __init__(self, seeds: Sequence[int], shape: Sequence[int], *, num_steps: int, noise_key: NestedKey = NOISE):
        super().__init__()
        self.in_keys: list[NestedKey] = []
        self.out_keys = [noise_key]
        draws = [torch.randn(num_steps, *shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
        self.register_buffer("draws", torch.stack(draws), persistent=False)  # [E, steps, *shape]
        self.step = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the noise of the current step and moves on to the next."""
        if self.step == self.draws.shape[1]:
            raise RuntimeError(f"noise was drawn for {self.step} steps only")
        tensordict.set(self.out_keys[0], self.draws[:, self.step])
        self.step += 1
        return tensordict


class RecordedFutures(TensorDictModuleBase):
    """Writes the recorded states that follow the current step, for a :class:`RecordedPlanner` to hand on.

    Args:
        futures (Tensor): for every environment and control step the states that follow ``[E, steps, H, d]``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.modules import RecordedFutures
        >>> futures = RecordedFutures(torch.arange(6.0).reshape(1, 2, 3, 1))
        >>> [futures(TensorDict(batch_size=[1]))["recorded_future"].flatten().tolist() for _ in range(2)]
        [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    """

    def __init__(self, futures: Tensor):
        super().__init__()
        self.in_keys: list[str] = []
        self.out_keys = [RECORDED_FUTURE]
        self.register_buffer("futures", futures, persistent=False)
        self.step = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the futures of the current step (the last ones when the record is over) and moves on."""
        tensordict.set(RECORDED_FUTURE, self.futures[:, min(self.step, self.futures.shape[1] - 1)])
        self.step += 1
        return tensordict


class RecordedPlanner(nn.Module):
    """A planner that knows the recorded future: what a controller does under it is its own doing.

    Args:
        planner (StatePlanner): the planner whose history, horizon and state it has.

    Examples:
        >>> import torch
        >>> from torchrl_koap.modules import RecordedPlanner, StatePlanner, TemporalUnet
        >>> planner = RecordedPlanner(StatePlanner(TemporalUnet(2, 4), state_dim=2))
        >>> planner.sample(torch.zeros(3, 2, 2), torch.ones(3, 14, 2)).shape
        torch.Size([3, 14, 2])
    """

    noise_key = RECORDED_FUTURE  # what a policy hands over is no noise here

    def __init__(self, planner: StatePlanner):
        super().__init__()
        for name in ("history", "horizon", "state_dim"):
            setattr(self, name, getattr(planner, name))

    def sample(self, history: Tensor, future: Tensor) -> Tensor:
        """The futures that :class:`RecordedFutures` wrote, ``[*B, H, d]``.

        Args:
            history (Tensor): observed states ``[*B, h, d]``.
            future (Tensor): recorded states that follow.
        """
        return future.expand(*history.shape[:-2], -1, -1)
