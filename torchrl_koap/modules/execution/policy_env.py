# This source code is licensed under the MIT license found in the LICENSE file.
"""An environment as the policies need it, whose seed fixes the whole rollout, the plans' start noise included."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.transforms import Compose

from torchrl_koap.keys import OBSERVATION
from torchrl_koap.modules.execution.receding_horizon import RecedingHorizonPolicy, policy_transforms
from torchrl_koap.modules.execution.replay import NOISE


class SeededNoise(Transform):
    """Writes start noise at every step, from a stream per environment: number ``i`` of a batch draws with ``seed + i``.

    TorchRL hands a seed to the innermost environment alone; :class:`PolicyEnv` hands it to this transform too.

    Args:
        shape (sequence of int): shape of one draw, ``planner.noise_shape``.

    Keyword Args:
        seed (int): seed until :meth:`set_seed`.
        noise_key (NestedKey): entry that is written, ``planner.noise_key``. Defaults to ``"noise"``.

    Examples:
        >>> from torchrl_koap.modules import SeededNoise
        >>> noise = SeededNoise((14, 2), seed=3)
        >>> noise.set_seed(4)
        >>> noise.seed
        4
    """

    def __init__(self, shape: Sequence[int], *, seed: int = 0, noise_key: NestedKey = NOISE):
        super().__init__(in_keys=[], out_keys=[noise_key])
        self.shape = tuple(shape)
        self.set_seed(seed)

    def set_seed(self, seed: int) -> None:
        """Begins all streams anew."""
        self.seed = int(seed)
        self._generators: list[torch.Generator] = []

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        batch = next_tensordict.batch_size
        if len(self._generators) != batch.numel():
            self._generators = [torch.Generator().manual_seed(self.seed + index) for index in range(batch.numel())]
        draws = [torch.randn(*self.shape, generator=generator) for generator in self._generators]
        noise = torch.stack(draws).reshape(*batch, *self.shape)
        return next_tensordict.set(self.out_keys[0], noise.to(next_tensordict.device or noise.device))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """The specification with the noise."""
        shape = (*observation_spec.shape, *self.shape)
        observation_spec[self.out_keys[0]] = Unbounded(shape, device=observation_spec.device)
        return observation_spec


class PolicyEnv(TransformedEnv):
    """An environment with what a policy reads: the last observations, and start noise.

    ``set_seed`` fixes the whole rollout. With the same seed an :class:`~torchrl_koap.modules.Agent` gives the same
    actions in the first episode. It may stand inside of :class:`torchrl.envs.SerialEnv`,
    :class:`torchrl.envs.ParallelEnv` and collectors, or around the former.

    Args:
        env (EnvBase): the environment.
        policy (RecedingHorizonPolicy): the policy that is to act in it.

    Keyword Args:
        observation_key (NestedKey): entry of the observation ``[*B, obs]``. Defaults to ``"observation"``.

    Examples:
        >>> from torchrl_koap.envs import AvoidingEnv
        >>> from torchrl_koap.modules import PlanThenControl, PolicyEnv, StatePlanner, TemporalUnet
        >>> from torchrl_koap.modules import make_koopman_inverse_dynamics
        >>> planner = StatePlanner(TemporalUnet(2, 4), state_dim=2)
        >>> policy = PlanThenControl(
        ...     planner, make_koopman_inverse_dynamics(2, 2), state_columns=(2, 3), history=5)
        >>> env = PolicyEnv(AvoidingEnv(2), policy)
        >>> _ = env.set_seed(0)
        >>> env.reset()["observation_history"].shape, env.reset()["noise"].shape
        (torch.Size([2, 5, 4]), torch.Size([2, 14, 2]))
    """

    def __init__(self, env: EnvBase, policy: RecedingHorizonPolicy, *, observation_key: NestedKey = OBSERVATION):
        key = policy.planner.noise_key  # None: the planner draws by itself
        noise = [] if key is None else [SeededNoise(policy.noise_shape, noise_key=key)]
        transforms = policy_transforms(policy.history, observation_key=observation_key, history_key=policy.in_keys[0])
        super().__init__(env, Compose(*(transform.clone() for transform in transforms), *noise))

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds the environment and the noise.

        Args:
            seed (int, optional): the seed.
            static_seed (bool): return the same seed as that of the next environment.

        Returns:
            int: the seed for the next environment.
        """
        if seed is not None:
            for transform in self.transform:
                if isinstance(transform, SeededNoise):
                    transform.set_seed(seed)
        return super().set_seed(seed, static_seed=static_seed)
