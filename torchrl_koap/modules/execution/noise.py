# This source code is licensed under the MIT license found in the LICENSE file.
"""The one source of the plans' start noise: a stream per episode, fixed by its seed."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import Transform

NOISE = "noise"


class NoiseStreams:
    """Draws standard normal noise of episodes, which depends on an episode's seed and step alone.

    There is a seed per episode. Numbers are drawn for a block of steps at once (``policy.max_steps``), since torch
    fills tensors in groups of 16, so that draws step by step would be others. A draw has the shape
    ``policy.noise_shape``.
    """

    def __init__(self, seeds: Sequence[int], shape: Sequence[int], *, block: int):
        self.shape, self.block = tuple(shape), block
        self._generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
        self._draws = torch.empty(0)
        self._left = 0

    def __len__(self) -> int:
        return len(self._generators)

    def draw(self) -> Tensor:
        """The noise of the next step ``[E, *shape]``."""
        if not self._left:
            size = (self.block, *self.shape)
            self._draws = torch.stack([torch.randn(size, generator=g, dtype=torch.float32) for g in self._generators])
            self._left = self.block
        self._left -= 1
        return self._draws[:, self.block - 1 - self._left]


class NoiseTransform(Transform):
    """Writes start noise at every reset and step of an environment; number ``i`` of a batch draws with ``seed + i``.

    TorchRL hands a seed to the innermost environment alone; :class:`~torchrl_koap.modules.PolicyEnv` hands it to this
    transform too. Arguments are those of :class:`NoiseStreams`, and the entry that is written, ``planner.noise_key``.
    """

    def __init__(self, shape: Sequence[int], *, block: int, noise_key: NestedKey = NOISE):
        super().__init__(in_keys=[], out_keys=[noise_key])
        self.shape, self.block = tuple(shape), block
        self.set_seed(0)

    def set_seed(self, seed: int) -> None:
        """Begins all streams anew."""
        self.seed = int(seed)
        self._streams = NoiseStreams([], self.shape, block=self.block)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        count = next_tensordict.batch_size.numel()
        if len(self._streams) != count:
            self._streams = NoiseStreams(range(self.seed, self.seed + count), self.shape, block=self.block)
        noise = self._streams.draw().reshape(*next_tensordict.batch_size, *self.shape)
        return next_tensordict.set(self.out_keys[0], noise.to(next_tensordict.device or noise.device))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """The specification with the noise."""
        shape = (*observation_spec.shape, *self.shape)
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=observation_spec.device)
        return observation_spec
