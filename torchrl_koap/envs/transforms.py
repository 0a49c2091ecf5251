# This source code is licensed under the MIT license found in the LICENSE file.
"""TorchRL transforms for partial observability, as in PO-Sorting."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs.transforms import ObservationTransform

from torchrl_koap.keys import OBSERVATION
from torchrl_koap.tasks import Task, get_task


class PartialObservation(ObservationTransform):
    """Reduces observations ``[*B, obs]`` to states, ``Task.state_of``: no command, no columns of ``Task.hidden``.

    Raises:
        ValueError: when applied, if the observation has another number of columns than the task.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.envs.transforms import PartialObservation
        >>> hide = PartialObservation("po_sorting")
        >>> hide(TensorDict({"observation": torch.zeros(3, 16)}, [3]))["observation"].shape
        torch.Size([3, 10])
    """

    def __init__(self, task: Task | str):
        super().__init__(in_keys=[OBSERVATION], out_keys=[OBSERVATION])
        self.task = get_task(task)

    def _apply_transform(self, observation: Tensor) -> Tensor:
        return self.task.state_of(observation)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Returns the specification without the removed columns."""
        spec = observation_spec[OBSERVATION]
        shape = (*spec.shape[:-1], self.task.state_dim)
        observation_spec[OBSERVATION] = Unbounded(shape, device=spec.device, dtype=spec.dtype)
        return observation_spec


class EndEffectorNoise(ObservationTransform):
    """Adds Gaussian noise to the measured end effector, at random unless :meth:`seed_episodes` gives seeds.

    The seed of the environment does not affect the noise. An environment that a mask of TorchRL (``_reset``, ``_step``)
    leaves out draws nothing and keeps its noise.

    Args:
        task (Task or str): the task; noise is added to its part ``Task.position``.
        sigma (float): standard deviation (m).

    Raises:
        ValueError: if sigma is negative.

    Examples:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_koap.envs import AvoidingEnv
        >>> from torchrl_koap.envs.transforms import EndEffectorNoise
        >>> env = TransformedEnv(AvoidingEnv(), EndEffectorNoise("avoiding", sigma=0.002))
        >>> clean, noisy = env.base_env.reset()["observation"], env.reset()["observation"]
        >>> (clean != noisy).tolist()
        [[False, False, True, True]]
    """

    def __init__(self, task: Task | str, sigma: float):
        if not sigma >= 0:
            raise ValueError(f"sigma must be >= 0, got {sigma}")
        super().__init__(in_keys=[OBSERVATION], out_keys=[OBSERVATION])
        task = get_task(task)
        self.sigma, self.part = sigma, task.observation[task.position]
        self._generators = [torch.Generator()]
        self._generators[0].seed()  # at random
        self._noise = torch.zeros(0)  # of the last observation

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Gives every environment its own noise, so that an episode does not depend on the batch it runs in."""
        self._generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]

    def _apply_transform(self, observation: Tensor, mask: Tensor | None = None) -> Tensor:
        observation = observation.clone()
        measured = observation[..., self.part]
        if mask is None or not len(self._noise) == len(measured) == mask.numel():
            mask, self._noise = torch.ones(len(measured), dtype=torch.bool), torch.zeros_like(measured, device="cpu")
        rows, kind = mask.flatten().nonzero().flatten().tolist(), {"dtype": self._noise.dtype}
        size = measured.shape[1:]
        if len(self._generators) == 1:
            self._noise[rows] = torch.randn((len(rows), *size), generator=self._generators[0], **kind)
        else:
            for row in rows:
                self._noise[row] = torch.randn(size, generator=self._generators[row], **kind)
        observation[..., self.part] = measured + self.sigma * self._noise.to(observation.device)
        return observation

    def _measured(self, tensordict: TensorDictBase, mask: Tensor | None) -> TensorDictBase:
        return tensordict.set(OBSERVATION, self._apply_transform(tensordict[OBSERVATION], mask))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._measured(tensordict_reset, tensordict.get("_reset", None))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._measured(next_tensordict, tensordict.get("_step", None))
