# This source code is licensed under the MIT license found in the LICENSE file.
"""Partial observability as TorchRL transforms: what makes PO-Sorting of Sorting."""

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
    """Drops parts of the observations ``[*B, obs]``: by default what ``Task.state_of`` leaves out.

    Args:
        task (Task or str): the task whose parts are named.
        drop (sequence of str, optional): parts to drop, names of ``Task.observation``. Default: the command and
            ``Task.hidden``.

    Raises:
        ValueError: for a part that the task does not have, or if nothing would remain. When applied, if the observation
            has another number of columns than the task.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_koap.envs.transforms import PartialObservation
        >>> hide = PartialObservation("po_sorting")
        >>> hide(TensorDict({"observation": torch.zeros(3, 16)}, [3]))["observation"].shape
        torch.Size([3, 10])
    """

    def __init__(self, task: Task | str, drop: Sequence[str] | None = None):
        super().__init__(in_keys=[OBSERVATION], out_keys=[OBSERVATION])
        self.task = get_task(task)
        parts, drop = self.task.observation, (self.task.command, *self.task.hidden) if drop is None else drop
        unknown = [name for name in drop if name not in (*parts, None)]
        if unknown:
            raise ValueError(f"task {self.task.name!r} has no part {unknown[0]!r}; known: {', '.join(parts)}")
        kept = [column for name, part in parts.items() if name not in drop for column in range(part.start, part.stop)]
        if not kept:
            raise ValueError(f"nothing of task {self.task.name!r} remains without {', '.join(drop)}")
        self.register_buffer("columns", torch.tensor(kept), persistent=False)

    def _apply_transform(self, observation: Tensor) -> Tensor:
        if observation.shape[-1] != self.task.observation_dim:
            wanted = f"{OBSERVATION!r} of task {self.task.name!r} has {self.task.observation_dim} columns"
            raise ValueError(f"{wanted}, got {observation.shape[-1]}")
        return observation[..., self.columns]

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """The specification without the dropped columns."""
        spec = observation_spec[OBSERVATION]
        shape = (*spec.shape[:-1], len(self.columns))
        observation_spec[OBSERVATION] = Unbounded(shape, device=spec.device, dtype=spec.dtype)
        return observation_spec


class EndEffectorNoise(ObservationTransform):
    """Adds Gaussian noise to the measured end effector.

    Args:
        task (Task or str): the task; its part ``Task.position`` is disturbed.
        sigma (float): standard deviation (m).
        seed (int): seed of the noise. After :meth:`seed_episodes` every environment has a generator of its own.

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

    def __init__(self, task: Task | str, sigma: float, seed: int = 0):
        if not sigma >= 0:
            raise ValueError(f"sigma must be >= 0, got {sigma}")
        super().__init__(in_keys=[OBSERVATION], out_keys=[OBSERVATION])
        task = get_task(task)
        self.sigma, self.part = sigma, task.observation[task.position]
        self._generators = [torch.Generator().manual_seed(seed)]

    def seed_episodes(self, seeds: Sequence[int]) -> None:
        """Gives every environment its own noise, so that an episode does not depend on the batch it runs in."""
        self._generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]

    def _apply_transform(self, observation: Tensor) -> Tensor:
        observation = observation.clone()
        measured = observation[..., self.part]
        kind = {"dtype": observation.dtype}
        if len(self._generators) == 1:
            noise = torch.randn(measured.shape, generator=self._generators[0], **kind)
        else:
            size = measured.shape[1:]
            noise = torch.stack([torch.randn(size, generator=generator, **kind) for generator in self._generators])
        observation[..., self.part] = measured + self.sigma * noise.to(observation.device)
        return observation

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)
