# This source code is licensed under the MIT license found in the LICENSE file.
"""Environment transforms that policies need: the history of observations, and seeded start noise."""

from __future__ import annotations

import secrets
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.transforms import CatFrames, Compose, InitTracker, UnsqueezeTransform

from torchrl_koap.keys import OBSERVATION
from torchrl_koap.modules.execution.policy import IS_INIT, OBSERVATION_HISTORY, PlanningPolicy

NOISE = "noise"


class NoiseStreams:
    """Draws standard normal noise of episodes that depends only on the seed of the episode and the step.

    Noise of shape ``policy.noise_shape`` is drawn for a block of steps at once (``policy.max_steps``). Step-by-step
    draws would give other numbers, since torch fills tensors in groups of 16.
    """

    def __init__(self, seeds: Sequence[int], shape: Sequence[int], *, block: int):
        self.shape, self.block = tuple(shape), block
        self._generators = [torch.Generator().manual_seed(int(seed)) for seed in seeds]
        self._draws = torch.empty(0)
        self._left = 0

    def __len__(self) -> int:
        return len(self._generators)

    def draw(self) -> Tensor:
        """Returns the noise of the next step ``[E, *shape]``."""
        if not self._left:
            size = (self.block, *self.shape)
            self._draws = torch.stack([torch.randn(size, generator=g, dtype=torch.float32) for g in self._generators])
            self._left = self.block
        self._left -= 1
        return self._draws[:, self.block - 1 - self._left]


class NoiseTransform(Transform):
    """Writes start noise at every reset and step of an environment; environment ``i`` of a batch uses ``seed + i``.

    The seed is random until :meth:`set_seed`. TorchRL seeds only the innermost environment, so
    :class:`~torchrl_koap.modules.PolicyEnv` also seeds this transform. Arguments are those of :class:`NoiseStreams`,
    and the entry to write, ``planner.noise_key``.
    """

    def __init__(self, shape: Sequence[int], *, block: int, noise_key: NestedKey = NOISE):
        super().__init__(in_keys=[], out_keys=[noise_key])
        self.shape, self.block = tuple(shape), block
        self.set_seed(secrets.randbits(62))  # torch's generator has the same default seed in every new process

    def set_seed(self, seed: int) -> None:
        """Restarts all streams with a seed."""
        self.seed = int(seed)
        self._streams = NoiseStreams([], self.shape, block=self.block)
        self._drawn: Tensor | None = None  # noise of the present step

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        count = next_tensordict.batch_size.numel()
        if len(self._streams) != count:
            self._streams = NoiseStreams(range(self.seed, self.seed + count), self.shape, block=self.block)
        noise = self._streams.draw().reshape(*next_tensordict.batch_size, *self.shape)
        self._drawn = noise.to(next_tensordict.device or noise.device)
        return next_tensordict.set(self.out_keys[0], self._drawn)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        begins = [tensordict.get(key, None) for key in self.parent.reset_keys]
        if self._drawn is None or all(mask is None or mask.all() for mask in begins):
            return self._call(tensordict_reset)
        # the noise after an episode's last step is unused: a new draw would advance the streams of running episodes
        return tensordict_reset.set(self.out_keys[0], self._drawn)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Adds the noise to the specification."""
        shape = (*observation_spec.shape, *self.shape)
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=observation_spec.device, dtype=torch.float32)
        return observation_spec


def policy_transforms(
    history: int, *, observation_key: NestedKey = OBSERVATION, history_key: NestedKey = OBSERVATION_HISTORY
) -> Compose:
    """Makes the environment transforms that policies need: ``is_init`` and the last ``history`` observations.

    At the start of an episode the first observation is repeated.

    Args:
        history (int): observed frames, the present one included.
        observation_key (NestedKey): entry of the observation ``[*B, obs]``.
        history_key (NestedKey): entry that the policy reads, its ``in_keys[0]``.

    Returns:
        Compose: writes the history ``[*B, history, obs]``, the present one last.

    Examples:
        >>> from torchrl_koap.modules import policy_transforms
        >>> len(policy_transforms(5))
        3
    """
    return Compose(
        InitTracker(init_key=IS_INIT),
        UnsqueezeTransform(-2, in_keys=[observation_key], out_keys=[history_key]),
        CatFrames(N=history, dim=-2, in_keys=[history_key], out_keys=[history_key]),
    )


class PolicyEnv(TransformedEnv):
    """An environment that also returns the inputs of a policy: the last observations, and start noise.

    ``set_seed`` makes the whole rollout reproducible; without it the noise is random. Call it before making a
    collector, which begins the first episodes at once. With the same seed an :class:`~torchrl_koap.modules.Agent`
    returns the same actions in the first episode. It works inside :class:`torchrl.envs.SerialEnv`,
    :class:`torchrl.envs.ParallelEnv` and collectors, or around a :class:`torchrl.envs.SerialEnv`.

    Args:
        env (EnvBase): the environment.
        policy (PlanningPolicy): the policy that acts in it.
        observation_key (NestedKey): entry of the observation ``[*B, obs]``. Defaults to ``"observation"``.

    Raises:
        ValueError: if the policy has ``origins``: only an Agent subtracts and adds them; if ``done`` is nested; or if
            the environment has no such observation.

    Examples:
        >>> from torchrl_koap.envs import AvoidingEnv
        >>> from torchrl_koap.modules import PolicyEnv, StatePlanner, TemporalUnet, make_policy
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> policy = make_policy(planner, make_koopman_inverse_dynamics(2, 2), state_of=(2, 3))
        >>> env = PolicyEnv(AvoidingEnv(2), policy)
        >>> _ = env.set_seed(0)
        >>> env.reset()["observation_history"].shape, env.reset()["noise"].shape
        (torch.Size([2, 5, 4]), torch.Size([2, 14, 2]))
    """

    def __init__(self, env: EnvBase, policy: PlanningPolicy, *, observation_key: NestedKey = OBSERVATION):
        if policy.origins is not None:
            raise ValueError("PolicyEnv does not support policies with origins: use an Agent, which applies them")
        if "done" not in env.done_keys:  # TorchRL would renew only the entries beside ``done`` at a reset
            raise ValueError(f"PolicyEnv needs the key 'done', got {env.done_keys}: rename them by a RenameTransform")
        if observation_key not in (entries := env.observation_spec.keys(True, True)):
            raise ValueError(
                f"the environment has no {observation_key!r}: name one of {list(entries)} by observation_key"
            )
        key = policy.planner.noise_key  # None: the planner draws its own noise
        transforms = policy_transforms(policy.history, observation_key=observation_key, history_key=policy.in_keys[0])
        if key is not None:
            transforms.append(NoiseTransform(policy.noise_shape, block=policy.max_steps, noise_key=key))
        super().__init__(env, transforms)

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds the environment and the noise; as in :class:`torchrl.envs.EnvBase`."""
        if seed is not None:
            for transform in self.transform:
                if isinstance(transform, NoiseTransform):
                    transform.set_seed(seed)
        return super().set_seed(seed, static_seed=static_seed)
