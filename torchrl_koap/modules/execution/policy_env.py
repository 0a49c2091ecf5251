# This source code is licensed under the MIT license found in the LICENSE file.
"""An environment as the policies need it, whose seed fixes the whole rollout, the plans' start noise included."""

from __future__ import annotations

from tensordict import NestedKey
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.transforms import CatFrames, Compose, InitTracker, UnsqueezeTransform

from torchrl_koap.keys import OBSERVATION
from torchrl_koap.modules.execution.noise import NoiseTransform
from torchrl_koap.modules.execution.policy import IS_INIT, OBSERVATION_HISTORY, PlanningPolicy


def policy_transforms(
    history: int, *, observation_key: NestedKey = OBSERVATION, history_key: NestedKey = OBSERVATION_HISTORY
) -> Compose:
    """Environment transforms that the policies need: ``is_init`` and the last ``history`` observations.

    At the start of an episode the first observation is repeated.

    Args:
        history (int): observed frames, the present one included.

    Keyword Args:
        observation_key (NestedKey): entry of the observation ``[*B, obs]``.
        history_key (NestedKey): entry that the policy reads, its ``in_keys[0]``.

    Returns:
        Compose: transforms for a ``TransformedEnv``.

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
    """An environment with what a policy reads: the last observations, and start noise.

    ``set_seed`` fixes the whole rollout. With the same seed an :class:`~torchrl_koap.modules.Agent` gives the same
    actions in the first episode. It may stand inside of :class:`torchrl.envs.SerialEnv`,
    :class:`torchrl.envs.ParallelEnv` and collectors, or around a :class:`torchrl.envs.SerialEnv`.

    Args:
        env (EnvBase): the environment.
        policy (PlanningPolicy): the policy that is to act in it.

    Keyword Args:
        observation_key (NestedKey): entry of the observation ``[*B, obs]``. Defaults to ``"observation"``.

    Raises:
        ValueError: if the data of the policy lack an origin, which only an Agent subtracts and adds.

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
            raise ValueError("the data of this policy lack an origin, which an Agent subtracts and adds: act with one")
        key = policy.planner.noise_key  # None: the planner draws by itself
        noise = [] if key is None else [NoiseTransform(policy.noise_shape, block=policy.max_steps, noise_key=key)]
        transforms = policy_transforms(policy.history, observation_key=observation_key, history_key=policy.in_keys[0])
        super().__init__(env, Compose(*(transform.clone() for transform in transforms), *noise))

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Seeds the environment and the noise; as in :class:`torchrl.envs.EnvBase`."""
        if seed is not None:
            for transform in self.transform:
                if isinstance(transform, NoiseTransform):
                    transform.set_seed(seed)
        return super().set_seed(seed, static_seed=static_seed)
